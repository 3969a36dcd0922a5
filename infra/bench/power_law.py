"""error = a N^-b, fitted with its uncertainty."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

CONFIDENCE = 0.95
FARTHEST = 10.0
"""How far beyond the largest N the law may be used; it was not seen there."""


@dataclass(frozen=True, kw_only=True)
class PowerLaw:
    """A straight line through the logarithms, by least squares."""

    exponent: float
    """b: each doubling of N divides the error by 2^b."""
    exponent_low: float
    exponent_high: float
    """Ends of its 95 % interval, from the scatter about the line by Student's t; not a number where
    there are no more points than the line has parameters."""
    factor: float
    """a."""
    largest: float
    """The largest N of the fit."""

    def at(self, count: float) -> float:
        """Return the error that the law says of N.

        Raises:
            ValueError: N is more than ten times the largest that was measured.
        """
        if count > FARTHEST * self.largest:
            raise ValueError(
                f"N = {count:g} is beyond {FARTHEST:g} times the largest measured, {self.largest:g}"
            )
        return self.factor * count**-self.exponent


def fit_power_law(counts: Sequence[float], errors: Sequence[float]) -> PowerLaw:
    """Fit measured errors, one for each run; repeats of the same N count as they are.

    Raises:
        ValueError: fewer than two different N.
    """
    if len(set(counts)) < 2:
        raise ValueError(f"a power law needs two different N; got {sorted(set(counts))}")
    x, y = np.log(np.asarray(counts, float)), np.log(np.asarray(errors, float))
    centred = x - x.mean()
    slope = float((centred * y).sum() / (centred**2).sum())
    residual = y - y.mean() - slope * centred
    freedom = len(x) - 2
    half = math.nan
    if freedom > 0:
        deviation = math.sqrt(float((residual**2).sum()) / freedom / float((centred**2).sum()))
        half = float(student.ppf(0.5 + CONFIDENCE / 2, freedom)) * deviation
    return PowerLaw(
        exponent=-slope,
        exponent_low=-slope - half,
        exponent_high=-slope + half,
        factor=math.exp(float(y.mean()) - slope * float(x.mean())),
        largest=float(max(counts)),
    )
