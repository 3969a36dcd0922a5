"""Stopping rule of adaptive sampling: at all targets of a view, or at the cap.

Targets and measured floors go by the name of their metric (storage.metrics). One view may need many
more samples by one metric than by another: the linear PSNR weighs bright pixels more, up to
radiance 1, and empty background raises every mean but the one over objects. So each target that is
missed is extrapolated by what a doubling of the samples bought in its own metric, and the one that
needs most samples governs.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

Floors = Mapping[str, float]
"""Decibels by metric."""

Measured = Sequence[tuple[int, Floors]]
"""Samples per pixel and the floors that were measured then, in order."""

_DB_PER_DOUBLING = 1.2
"""The true error falls by 0.9 to 2.0 dB per doubling of the samples, not by 3. This low guess is
used until the view itself has been measured twice."""

_SLOWEST_DB = 0.6
"""Smallest gain per doubling that is believed: two floors of a view are noisy."""

_FASTEST_DB = 3.0
"""Largest gain per doubling that is believed."""

_MAX_GROWTH = 2.0
"""The samples grow at most by this between two measurements: each of them is a new choice of tiles.
With 4 half of what these gain was lost."""


@dataclass(frozen=True, kw_only=True)
class Goal:
    """Targets and cap of the samples of a view."""

    targets_db: Floors
    """Stated errors to reach, in dB by metric."""
    step: int
    """Samples per pixel that one pass adds, both halves together."""
    max_spp: int
    """Maximum samples per pixel, a multiple of `step`."""


def gaps_db(targets_db: Floors, floors_db: Floors) -> dict[str, float]:
    """Return by how many dB each target is missed, by metric; without those that are reached."""
    gaps = {metric: target_db - floors_db[metric] for metric, target_db in targets_db.items()}
    return {metric: gap_db for metric, gap_db in gaps.items() if gap_db > 0}


def next_spp(measured: Measured, goal: Goal) -> int:
    """Return the number of samples at which the floors are measured next.

    Args:
        measured: of this view so far; the last floors miss a target of the goal, and their samples
            are a multiple of its step below its cap.
        goal: when sampling ends.
    """
    spp = measured[-1][0]
    step = goal.step
    growth = max(step * math.ceil(spp * _MAX_GROWTH / step), spp + step)
    return min(expected_spp(measured, goal), growth)


def expected_spp(measured: Measured, goal: Goal) -> int:
    """Return the number of samples that should reach all targets, or the cap; as `next_spp`."""
    spp, floors_db = measured[-1]
    gaps = gaps_db(goal.targets_db, floors_db)
    needed_doublings = max(gap_db / slope_db(measured, metric) for metric, gap_db in gaps.items())
    doublings = min(needed_doublings, math.log2(goal.max_spp / spp) + 1)
    target_spp = goal.step * math.ceil(spp * 2**doublings / goal.step)
    return min(goal.max_spp, max(target_spp, spp + goal.step))


def slope_db(measured: Measured, metric: str) -> float:
    """Return what a doubling of the samples buys in this view, in dB, from its last two floors.

    Args:
        measured: of this view so far; one measurement is enough.
        metric: whose floors are compared.
    """
    if len(measured) < 2:
        return _DB_PER_DOUBLING
    (before, lower_db), (now, upper_db) = measured[-2:]
    gain_db = upper_db[metric] - lower_db[metric]
    return min(max(gain_db / math.log2(now / before), _SLOWEST_DB), _FASTEST_DB)
