"""Detection of spikes in loss and gradient norm, with the scenes that may cause them."""

import math
import statistics
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from train.loop.step import StepReport

REMEMBERED = 200
"""Number of recent steps that a new one is compared with."""

LEAST_REMEMBERED = 40
"""Minimum number of recent steps; a median of fewer is unreliable."""

LEAST_DEVIATION = 0.02
"""Minimum standard deviation as a fraction of the median; otherwise a nearly constant loss would
spike at the smallest change."""

_MAD_TO_DEVIATION = 1.4826
"""Ratio of standard deviation to median absolute deviation of normal numbers."""


@dataclass(frozen=True, kw_only=True)
class Spike:
    """Loss or gradient norm of a step above its bound."""

    step: int
    """Number of the step, from 1."""
    what: str
    """Name of the value, `loss` or `grad_norm`."""
    value: float
    bound: float
    """Upper bound that the value exceeds."""
    keys: tuple[str, ...]
    """Sample keys of this process's scenes in the step."""


class SpikeDetector:
    """Compares each step with the median of recent ones, in robust standard deviations.

    A median is robust to earlier spikes, and a falling loss, as at the start of a training, is no
    spike. Steps that are not finite are ignored here: they are skipped and reported elsewhere.
    """

    def __init__(self, deviations: float) -> None:
        self._deviations = deviations
        self._recent = {what: deque[float](maxlen=REMEMBERED) for what in ("loss", "grad_norm")}

    def add(self, step: int, report: StepReport, keys: Sequence[str]) -> list[Spike]:
        """Add a step, counted from 1, and return its spikes."""
        spikes = []
        for what, recent in self._recent.items():
            value = getattr(report, what)
            if not math.isfinite(value):
                continue
            bound = spike_bound(recent, self._deviations)
            if bound is not None and value > bound:
                spike = Spike(step=step, what=what, value=value, bound=bound, keys=tuple(keys))
                spikes.append(spike)
            recent.append(value)
        return spikes


def spike_bound(recent: Sequence[float], deviations: float) -> float | None:
    """Return the median plus so many robust deviations, or None for too few values."""
    if len(recent) < LEAST_REMEMBERED:
        return None
    median = statistics.median(recent)
    spread = statistics.median(abs(value - median) for value in recent)
    deviation = max(_MAD_TO_DEVIATION * spread, LEAST_DEVIATION * abs(median))
    return median + deviations * deviation
