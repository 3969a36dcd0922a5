"""What the first view of a scene takes, and a further one: core-seconds once everything is warm."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

REPEATS = 3
"""Counted times that a scene is loaded and shown; the median counts."""

Show = Callable[[], NDArray[np.float32]]
"""Makes the picture [R, R, 3] of a loaded scene."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TimedViews:
    """A picture, and what it takes."""

    radiance_rgb: NDArray[np.float32]
    """[R, R, 3] linear radiance."""
    first_s: float
    """Core-seconds of loading the scene and showing it."""
    further_s: float
    """Core-seconds of showing it once more."""


def timed_views(load: Callable[[], Show], repeats: int = REPEATS) -> TimedViews:
    """Load a scene and show it twice, once to warm up and then `repeats` times that count.

    Core-seconds are those of this process with all of its threads.
    """
    found = [_once(load) for _ in range(1 + repeats)][1:]
    return TimedViews(
        radiance_rgb=found[-1].radiance_rgb,
        first_s=_median([one.first_s for one in found]),
        further_s=_median([one.further_s for one in found]),
    )


def _once(load: Callable[[], Show]) -> TimedViews:
    began = time.process_time()
    show = load()
    show()
    shown = time.process_time()
    picture = show()
    again = time.process_time()
    return TimedViews(radiance_rgb=picture, first_s=shown - began, further_s=again - shown)


def _median(seconds: Sequence[float]) -> float:
    return float(np.median(seconds))
