"""A preview is made of the parts that price it, no more and no fewer; each can be timed."""

from collections import Counter
from typing import Any

import numpy as np
import pytest

from pipeline.renders import preview
from pipeline.renders.camera import Camera
from pipeline.renders.preview import PreviewRenderer, PreviewSettings
from pipeline.renders.preview_parts import all_parts, preview_parts, seconds_of, timed_parts
from pipeline.renders.renderer import finished
from pipeline.renders.settings import Filtered
from pipeline.renders.tracer import Features
from tests.scenes_by_hand import tiny_scene


class CountingTracer:
    """Makes flat pictures, and remembers by the names of parts what it was asked for."""

    def __init__(self) -> None:
        self.asked: Counter[str] = Counter()

    def radiance(self, camera: Camera, *, seed: int, spp: int) -> Any:
        self.asked[f"pass of {spp}"] += 1
        return np.ones((camera.resolution, camera.resolution, 3), np.float32)

    def features(self, camera: Camera, *, spp: int) -> Features:
        self.asked[f"guides of {spp}"] += 1
        flat = np.ones((camera.resolution, camera.resolution, 3), np.float32)
        return Features(albedo=flat, normal=flat)


@pytest.mark.parametrize("denoiser", ["off", "fast", "high"])
def test_a_preview_is_made_of_its_parts(
    denoiser: Filtered, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracer, scene = CountingTracer(), tiny_scene()
    monkeypatch.setattr(preview, "load_tracer", lambda scene, **depths: tracer)

    def filtered(picture: Any, features: Features, quality: str) -> Any:
        tracer.asked[quality] += 1
        return picture

    monkeypatch.setattr(preview, "denoise", filtered)
    for spp in (1, 2, 3, 15, 16, 63, 64, 85, 1024, 4096):
        tracer.asked.clear()
        settings = PreviewSettings(resolution=8, spp=spp, denoiser=denoiser)
        finished(PreviewRenderer(scene, settings).view_steps(scene.c2w[0], 40.0, 0))
        assert tracer.asked == preview_parts(spp, denoiser), spp
        assert set(tracer.asked) <= set(all_parts())


def test_each_part_is_timed_in_its_order() -> None:
    """A clock that ticks once a look gives each part one tick, since each is timed between two."""
    ticks = iter(range(10_000))
    found = timed_parts(tiny_scene(), 16, lambda: float(next(ticks)))
    assert set(found) == set(all_parts())
    assert set(found.values()) == {1.0}


def test_what_is_traced_and_filtered_takes_time() -> None:
    found = timed_parts(tiny_scene(), 64)
    assert all(seconds > 0 for seconds in found.values())
    # 64 samples are 16 times the work of 4 and never as quick, whatever else the machine does
    assert found["pass of 64"] > found["pass of 4"]
    assert seconds_of(preview_parts(8, "fast"), found) == pytest.approx(
        2 * found["pass of 4"] + found["guides of 4"] + found["fast"]
    )
