"""Where numbers stand on a chart, and how they are written."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

_STEPS = (1.0, 2.0, 5.0, 10.0)
_WANTED_TICKS = 4
_SUFFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"))
_LEAST_LOG = 1e-12


@dataclass(frozen=True)
class Axis:
    """Maps values to 0 ... 1."""

    low: float
    high: float
    log: bool = False
    """Whether equal factors are equal lengths; values are then above 0."""

    def place(self, value: float) -> float:
        """Return where a value stands; outside of the axis it is at its end."""
        if self.log:
            value = max(value, _LEAST_LOG)
            share = math.log(value / self.low) / math.log(self.high / self.low)
        else:
            share = (value - self.low) / (self.high - self.low)
        return min(max(share, 0.0), 1.0)

    def ticks(self) -> list[float]:
        """Return a few round values on the axis."""
        if self.log:
            found = _log_ticks(self.low, self.high)
            if len(found) >= 2:
                return found
        return _even_ticks(self.low, self.high)


def axis_of(values: Sequence[float], *, log: bool = False, from_zero: bool = False) -> Axis:
    """Return an axis that holds all values, which are finite; `log` only where all are above 0."""
    if not values:
        return Axis(0.0, 1.0)
    low, high = min(values), max(values)
    if log and low > 0:
        # a little room, and never an axis without length
        return Axis(low / 1.05, high * 1.05, log=True)
    low = min(low, 0.0) if from_zero else low
    room = 0.04 * (high - low) or 0.04 * abs(high) or 1.0
    return Axis(low if from_zero and low == 0 else low - room, high + room)


def short_number(value: float) -> str:
    """Return a number for a label: three digits, and k, M or G for large ones."""
    for size, suffix in _SUFFIXES:
        if abs(value) >= size * 0.9995:
            return f"{value / size:.3g}{suffix}"
    return f"{value:.3g}"


def _even_ticks(low: float, high: float) -> list[float]:
    rough = (high - low) / _WANTED_TICKS
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * size for size in _STEPS if power * size >= rough * 0.999)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [number * step for number in range(first, last + 1)]


def _log_ticks(low: float, high: float) -> list[float]:
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    every = max(1, math.ceil(math.log10(high / low) / 5))
    sizes = (1,) if math.log10(high / low) > 2 else (1, 2, 5)
    found = [size * 10.0**decade for decade in decades if decade % every == 0 for size in sizes]
    return [tick for tick in found if low <= tick <= high]
