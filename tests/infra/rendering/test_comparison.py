"""Flicker compares two frames of one scene or stage, and never scenes that are strangers."""

from pathlib import Path

import numpy as np
import pytest

from infra.rendering.comparison import Frame, flicker
from pipeline.exchange.open_scene import SceneSource
from tests.for_each import case


def frame(name: str, key: str | None, error: float) -> Frame:
    return Frame(
        source=SceneSource(path=Path(name), key=key),
        error_RR3=np.full((4, 4, 3), error, np.float32),
        noise_floor_db=20.0,
    )


FRAMES: list[tuple[tuple[str, str | None], tuple[str, str | None], bool]] = [
    (("a.safetensors", None), ("a.safetensors", None), True),
    (("stage.usda", "1"), ("stage.usda", "2"), True),
    (("s.tar", "000000001"), ("s.tar", "000000001"), True),
    (("s.tar", "000000001"), ("s.tar", "000000002"), False),
    (("0.h5", None), ("1.h5", None), False),
]


def test_only_frames_of_one_scene_or_stage_flicker() -> None:
    for before, now, goes_on in FRAMES:
        with case((before, now, goes_on)):
            found = flicker(frame(*before, 0.1), frame(*now, 0.2))
            assert (found is not None) == goes_on
            if found is not None:
                # a change of 0.1 everywhere is 20 dB; two floors of 20 dB are 3 dB worse together
                assert found.db == pytest.approx(20, abs=1e-4)
                assert found.noise_db == pytest.approx(20 - 10 * np.log10(2))


def test_the_first_frame_flickers_not_and_equal_errors_are_capped() -> None:
    first = frame("a.safetensors", None, 0.1)
    assert flicker(None, first) is None
    calm = flicker(first, first)
    assert calm is not None and calm.db == 100
