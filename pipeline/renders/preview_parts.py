"""Steps of a preview and their seconds, from which the cost of any preview is predicted."""

import time
from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, get_args

import numpy as np

from pipeline.renders.camera import PixelCamera
from pipeline.renders.denoiser import Quality, denoise
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.preview import PASSES, guide_rays, pass_sizes
from pipeline.renders.settings import PASS_SPP, Filtered, RenderSettings
from pipeline.renders.tracer import Features
from storage.records.scene import Scene

SCENE = "scene"
"""Loading the scene, once for all pictures of it."""

_REPEATS = 3
_LEAST_S = 0.2
"""A part that takes longer than this is timed once: what varies is small beside it."""
_SMALL = 32
_SEED = 20_261_124


def preview_parts(spp: int, denoiser: Filtered) -> Counter[str]:
    """Return how often each part occurs in a preview, by name, without loading the scene."""
    parts = Counter(_pass_name(size) for size in pass_sizes(spp))
    if denoiser != "off":
        parts.update([_guides_name(guide_rays(spp)), denoiser])
    return parts


def timed_parts(
    scene: Scene, resolution: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """Return the seconds of every part for the scene's first view; `activate` has been called.

    Args:
        scene: that passes `Scene.check`, with a camera.
        resolution: pixels each way.
        clock: returns seconds; `time.process_time` counts those of all threads.
    """
    pose = np.asarray(scene.c2w[0], np.float64)
    fov_deg = float(scene.fov_deg[0])
    depths = {"max_depth": RenderSettings.max_depth, "rr_depth": RenderSettings.rr_depth}
    load_tracer(scene, **depths)  # the first one loads libraries as well
    began = clock()
    tracer = load_tracer(scene, **depths)
    seconds = {SCENE: clock() - began}
    small = PixelCamera(c2w=pose, fov_deg=fov_deg, resolution=_SMALL)
    camera = PixelCamera(c2w=pose, fov_deg=fov_deg, resolution=resolution)
    for size in PASSES:
        tracer.radiance(small, seed=_SEED, spp=size)  # kernels are compiled, or read from disk
        seconds[_pass_name(size)] = _median_s(
            clock, partial(tracer.radiance, camera, seed=_SEED, spp=size)
        )
    for rays in PASS_SPP[1:]:
        tracer.features(small, spp=rays)
        seconds[_guides_name(rays)] = _median_s(clock, partial(tracer.features, camera, spp=rays))
    picture = tracer.radiance(camera, seed=_SEED, spp=1)
    features = tracer.features(camera, spp=4)
    for quality in get_args(Quality):
        _warm_up(resolution, quality)
        seconds[quality] = _median_s(clock, partial(denoise, picture, features, quality))
    return seconds


def _warm_up(resolution: int, quality: Quality) -> None:
    grey = np.ones((resolution, resolution, 3), np.float32)
    denoise(grey, Features(albedo=grey, normal=grey), quality)


def _median_s(clock: Callable[[], float], part: Callable[[], Any]) -> float:
    seconds = list[float]()
    while len(seconds) < _REPEATS and max(seconds, default=0) < _LEAST_S:
        began = clock()
        part()
        seconds.append(clock() - began)
    return float(np.median(seconds))


def _pass_name(size: int) -> str:
    return f"pass of {size}"


def _guides_name(rays: int) -> str:
    return f"guides of {rays}"


def all_parts() -> tuple[str, ...]:
    """Return the names of all parts, in the order in which they are timed."""
    passes = map(_pass_name, PASSES)
    guides = map(_guides_name, PASS_SPP[1:])
    return (SCENE, *passes, *guides, *get_args(Quality))


def seconds_of(parts: Mapping[str, int], part_s: Mapping[str, float]) -> float:
    """Return the seconds of parts that occur so often."""
    return sum(count * part_s[name] for name, count in parts.items())
