"""Where light paths begin and where they set out to, spread evenly over all paths of a pass."""

from typing import Any

import drjit as dr
import mitsuba as mi

from storage.seeds import seed_for

_GOLDEN = 1.1673039782614187
"""The root of x^5 = x + 1."""


def even_numbers(count: int, seed: int) -> list[Any]:
    """Return 4 arrays of `count` uniform numbers (Float, [0, 1)): points that fill 4 dimensions.

    Multiples of the 4 inverse powers of a generalised golden ratio (Roberts 2018), shifted by the
    seed. Any first part of them is spread evenly, so that any count will do.
    """
    lane = dr.arange(mi.UInt32, count)
    numbers = []
    for axis in range(4):
        stride = round(2**32 / _GOLDEN ** (axis + 1))
        shift = dr.opaque(mi.UInt32, 2 * seed_for(seed, "light paths", axis))
        numbers.append(mi.Float((lane * stride + shift) >> 8) * 2.0**-24)
    return numbers
