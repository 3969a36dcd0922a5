"""Deterministic functions of numbers: the same bytes on every processor.

IEEE arithmetic rounds + - * / and square roots the same everywhere, while libraries compute sin,
exp and powers by whatever the processor offers, and the last bit differs. Maps are known by the
hash of their bytes, so they are made of those five operations and of what stands here.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Numbers = NDArray[np.float64]

TEXELS_PER_CELL = 4
"""Fewest texels across a cell of noise, of a sky at the equator: octaves that are finer are left
out, so that none aliases."""

NOISE_SCALE = 2.0
"""Brings one octave of gradient noise to a standard deviation of about 0.4; it stays within 2."""

_TERMS = 12
"""Of the series of the sine: the first one left out is below 1e-19 up to a right angle."""


def sine(angle_rad: ArrayLike) -> Numbers:
    """Return the sine of angles from -pi to pi, to the rounding of float64."""
    angle = np.asarray(angle_rad, np.float64)
    folded = np.where(np.abs(angle) > math.pi / 2, np.sign(angle) * math.pi - angle, angle)
    square = folded * folded
    total = np.ones_like(square)
    for term in range(_TERMS, 0, -1):
        total = 1 - total * square / ((2 * term) * (2 * term + 1))
    return folded * total


def cosine(angle_rad: ArrayLike) -> Numbers:
    """Return the cosine of angles from -pi to pi, to the rounding of float64."""
    return sine(math.pi / 2 - np.abs(np.asarray(angle_rad, np.float64)))


def smoothstep(share: ArrayLike) -> Numbers:
    """Return 3 s^2 - 2 s^3 of numbers clamped to [0, 1]: from 0 to 1 without a kink."""
    s = np.clip(np.asarray(share, np.float64), 0, 1)
    return s * s * (3 - 2 * s)


def fade(x: NDArray) -> Numbers:
    """Return Perlin's curve of numbers in [0, 1], with two vanishing derivatives at both ends."""
    return x * x * x * (x * (6 * x - 15) + 10)


def ramp(distance_px: ArrayLike) -> Numbers:
    """Return how much of a texel is inside an edge, from the distance of its centre to the edge.

    Args:
        distance_px: in texels, positive inside.
    """
    return np.clip(np.asarray(distance_px, np.float64) + 0.5, 0, 1)


def lerp(one: ArrayLike, other: ArrayLike, share: ArrayLike) -> Numbers:
    """Return `one` where `share` is 0 and `other` where it is 1."""
    first = np.asarray(one, np.float64)
    return first + (np.asarray(other, np.float64) - first) * np.asarray(share)


def dot(one: NDArray, other: NDArray) -> Numbers:
    """Return the products [...] of vectors [..., 3] and [3], summed in one order everywhere."""
    return one[..., 0] * other[..., 0] + one[..., 1] * other[..., 1] + one[..., 2] * other[..., 2]
