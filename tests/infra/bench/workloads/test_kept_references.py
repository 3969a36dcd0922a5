"""A reference is rendered once, and a kept one gives the same figures."""

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from infra.bench.workloads.kept_references import kept_reference
from infra.rendering.raw_references import RawReference, first_camera
from pipeline.isolation import IsolatedChild
from tests.train.toy import toy_scene


class Counting:
    """A child that makes up its answers."""

    def __init__(self) -> None:
        self.calls = 0

    def call(self, *_: Any) -> RawReference:
        self.calls += 1
        rng = np.random.default_rng(self.calls)
        return RawReference(a_rgb=rng.random((8, 8, 3)), b_rgb=rng.random((8, 8, 3)))


def test_a_view_is_rendered_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path))
    counting = Counting()
    child, scene = cast(IsolatedChild, counting), toy_scene(0)
    first = kept_reference(child, scene, first_camera(scene, 8), 128)
    again = kept_reference(child, scene, first_camera(scene, 8), 128)
    assert counting.calls == 1
    np.testing.assert_array_equal(first.a_rgb, again.a_rgb)
    np.testing.assert_array_equal(first.b_rgb, again.b_rgb)
    assert first.a_rgb.dtype == np.float64 and not np.array_equal(first.a_rgb, first.b_rgb)
    for other in (
        (scene, first_camera(scene, 8), 256),
        (scene, first_camera(scene, 16), 128),
        (toy_scene(1), first_camera(scene, 8), 128),
    ):
        kept_reference(child, *other)
    assert counting.calls == 4, "other samples, width or scene is another reference"
