"""Times of the first and of a further view of a scene: CPU seconds after a warm-up."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.records.scene import Scene
from storage.renderer import Camera, Renderer

REPEATS = 3
"""Number of measured repetitions after the warm-up; the result is their median."""

Show = Callable[[], NDArray[np.float32]]
"""Function that renders the picture [R, R, 3] of a loaded scene."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TimedViews:
    """Picture and its costs."""

    radiance_rgb: NDArray[np.float32]
    """[R, R, 3] linear radiance."""
    first_s: float
    """CPU seconds of loading the scene and rendering a view."""
    further_s: float
    """CPU seconds of rendering one more view."""


def timed_views(load: Callable[[], Show], repeats: int = REPEATS) -> TimedViews:
    """Load a scene and render it twice, once to warm up and then in `repeats` measured repetitions.

    CPU seconds are those of this process with all of its threads.
    """
    repetitions = [_once(load) for _ in range(1 + repeats)][1:]
    return TimedViews(
        radiance_rgb=repetitions[-1].radiance_rgb,
        first_s=_median([one.first_s for one in repetitions]),
        further_s=_median([one.further_s for one in repetitions]),
    )


def time_views(renderer: Renderer, scene: Scene, repeats: int = REPEATS) -> TimedViews:
    """Load a scene and render its first camera twice, once to warm up and then `repeats` times.

    CPU seconds are those that the renderer reports, of whatever process it renders in.
    """
    repetitions = [_render_twice(renderer, scene) for _ in range(1 + repeats)][1:]
    return TimedViews(
        radiance_rgb=repetitions[-1].radiance_rgb,
        first_s=_median([one.first_s for one in repetitions]),
        further_s=_median([one.further_s for one in repetitions]),
    )


def _render_twice(renderer: Renderer, scene: Scene) -> TimedViews:
    camera = Camera.of_scene(scene, 0)
    loaded = renderer.load(scene, "scene")
    first = loaded.render(camera)
    further = loaded.render(camera)
    first_s = (loaded.cpu_seconds or 0.0) + (first.cpu_seconds or 0.0)
    return TimedViews(
        radiance_rgb=further.radiance_rgb,
        first_s=first_s,
        further_s=further.cpu_seconds or 0.0,
    )


def _once(load: Callable[[], Show]) -> TimedViews:
    start = time.process_time()
    show = load()
    show()
    first_end = time.process_time()
    picture = show()
    second_end = time.process_time()
    return TimedViews(
        radiance_rgb=picture, first_s=first_end - start, further_s=second_end - first_end
    )


def _median(seconds: Sequence[float]) -> float:
    return float(np.median(seconds))
