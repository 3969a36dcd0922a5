"""Vectors [3, P] of many points, component by component; float32."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.hits.device_arrays import DeviceArray

Floats = NDArray
"""float32: numpy's own annotations cannot follow it through arithmetic."""

_TINY = np.float32(1e-20)
_LEAST_SHARE = np.float32(1e-3)
"""Least part of a vector across a normal, as a fraction, for a frame to be built on it."""


def dot(a: Floats, b: Floats) -> Floats:
    """Return [P] products."""
    if isinstance(a, DeviceArray):
        return (a * b).sum(axis=0)
    product: Floats = a[0] * b[0]
    product += a[1] * b[1]
    product += a[2] * b[2]
    return product


def brightest(a: Floats) -> Floats:
    """Return [P] the largest of the three components."""
    return np.maximum(np.maximum(a[0], a[1]), a[2])


def at_rows(array: Floats, rows: Any) -> Floats:
    """Return some rows of the last axis; numpy's `take` is five times as fast as an index."""
    return np.take(array, rows, axis=-1) if isinstance(rows, np.ndarray) else array[..., rows]


def unit(a: Floats) -> Floats:
    """Return vectors of length 1; those of length 0 stay 0."""
    return a / np.sqrt(np.maximum(dot(a, a), _TINY))


def cross(a: Floats, b: Floats) -> Floats:
    """Return [3, P]."""
    if isinstance(a, DeviceArray):
        return a.cross(b)
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def as_rows(a: Floats) -> Floats:
    """Return [P, 3], as Embree reads rays."""
    rows: Floats = a.T.copy()
    return rows


def tangents(n: Floats, along: Floats) -> tuple[Floats, Floats]:
    """Return two unit vectors across unit vectors n, the first of them towards `along`.

    An edge of the triangle, say: the frame then turns with the world. Where `along` is n or
    nothing, any frame is returned (Duff et al. 2017).
    """
    across = along - n * dot(along, n)
    length = np.sqrt(dot(across, across))
    lost = length <= _LEAST_SHARE * np.sqrt(dot(along, along))
    first = across / np.where(lost, np.float32(1), length)
    if lost.any():
        sign = np.where(n[2] >= 0, np.float32(1), np.float32(-1))
        a = -1 / (sign + n[2])
        b = n[0] * n[1] * a
        first = np.where(lost, np.stack([1 + sign * n[0] ** 2 * a, sign * b, -sign * n[0]]), first)
    return first, cross(n, first)


def spread(shift: Floats, index: int | NDArray[np.intp]) -> Floats:
    """Return points of a sequence in the unit square, moved by shifts [2, ...].

    `index` says which point, or which for each ([...]).

    It is R2 (Roberts 2018): its first points are far from each other for any count, and a
    random shift of each pixel makes them unbiased.
    """
    moved = shift.copy()
    for axis, step in enumerate((0.7548776662466927, 0.5698402909980532)):
        moved[axis] += np.asarray((index + 1) * step % 1, np.float32)
    return moved - np.floor(moved)


def cosine_direction(u: Floats, n: Floats, along: Floats) -> Floats:
    """Return directions around unit normals n, as often as their cosine is large.

    From u [2, P] in the unit square, in the frame of `tangents`.
    """
    radius = np.sqrt(u[0])
    angle = np.float32(2 * np.pi) * u[1]
    height = np.sqrt(np.maximum(1 - u[0], 0))
    first, second = tangents(n, along)
    return first * (radius * np.cos(angle)) + second * (radius * np.sin(angle)) + n * height
