"""Steps whose loss or gradient stands out, with the scenes that may be the reason."""

import math
import statistics
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from train.loop.step import StepReport

REMEMBERED = 200
"""Steps that a new one is compared with."""

LEAST_REMEMBERED = 40
"""Steps before which none stands out: a median of fewer says little."""

LEAST_DEVIATION = 0.02
"""Smallest standard deviation that is believed, as a share of the median: a loss that hardly moves
would else spike at every breath."""

_MAD_TO_DEVIATION = 1.4826
"""Standard deviation of normal numbers over their median absolute deviation."""


@dataclass(frozen=True, kw_only=True)
class Spike:
    """One figure of one step that stands out."""

    step: int
    """The step, from 1."""
    what: str
    """`loss` or `grad_norm`."""
    value: float
    """What it was."""
    bound: float
    """What it would have had to stay below."""
    keys: tuple[str, ...]
    """Keys of the scenes of the step that this process saw."""


class SpikeWatch:
    """Compares each step with the median of those before it, in robust standard deviations.

    Medians do not see a spike that they hold themselves, and a fall, as at the start of a training,
    is none. Steps that were not finite are no spikes: they are skipped and named elsewhere.
    """

    def __init__(self, deviations: float) -> None:
        self._deviations = deviations
        self._recent = {what: deque[float](maxlen=REMEMBERED) for what in ("loss", "grad_norm")}

    def add(self, step: int, report: StepReport, keys: Sequence[str]) -> list[Spike]:
        """Look at a step, from 1, and return what stands out of it."""
        found = []
        for what, recent in self._recent.items():
            value = getattr(report, what)
            if not math.isfinite(value):
                continue
            bound = bound_of(recent, self._deviations)
            if bound is not None and value > bound:
                spike = Spike(step=step, what=what, value=value, bound=bound, keys=tuple(keys))
                found.append(spike)
            recent.append(value)
        return found


def bound_of(recent: Sequence[float], deviations: float) -> float | None:
    """Return the median and so many robust deviations; None of too few values."""
    if len(recent) < LEAST_REMEMBERED:
        return None
    median = statistics.median(recent)
    spread = statistics.median(abs(value - median) for value in recent)
    deviation = max(_MAD_TO_DEVIATION * spread, LEAST_DEVIATION * abs(median))
    return median + deviations * deviation
