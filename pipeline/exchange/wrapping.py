"""Textures that do not repeat as textures that do, over the coordinates that a mesh has.

Ours repeat along u and v. Others are mirrored in every second tile, or end in their border or in
black. Over finitely many tiles all of these are one picture: the tiles side by side, which is then
looked up at coordinates that are moved and shrunk to [0, 1].
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Wrap = Literal["repeat", "mirror", "clamp", "black"]

MAX_TILES = 8
"""Most tiles along a side; beyond them, textures repeat."""

_INSIDE = 1e-4
"""How far coordinates may leave [0, 1] by rounding."""


@dataclass(frozen=True, kw_only=True)
class Tiles:
    """Which tiles along u or v a picture takes."""

    first: int
    """Number of the first tile; 0 is that of [0, 1]."""
    count: int
    """How many there are."""


def tiles_of(wraps: Sequence[Wrap], at: NDArray[np.floating]) -> Tiles:
    """Return the tiles that textures of one material need along an axis, at these coordinates.

    One where all repeat, or where no coordinate leaves [0, 1].
    """
    low, high = (float(at.min()), float(at.max())) if at.size else (0.0, 1.0)
    others = {wrap for wrap in wraps if wrap != "repeat"}
    if not others or (low >= -_INSIDE and high <= 1 + _INSIDE):
        return Tiles(first=0, count=1)
    if others == {"mirror"}:
        return Tiles(first=0, count=2)
    first, last = int(np.floor(low)), int(np.ceil(high))
    return Tiles(first=first, count=last - first)


def tiled(values: NDArray, wrap: Wrap, tiles: Tiles, axis: int) -> NDArray:
    """Return a picture [H, W, C] side by side along an axis, 0 for v and 1 for u."""
    parts = [
        _tile(values, wrap, number, axis)
        for number in range(tiles.first, tiles.first + tiles.count)
    ]
    return np.concatenate(parts, axis=axis) if len(parts) > 1 else parts[0]


def _tile(values: NDArray, wrap: Wrap, number: int, axis: int) -> NDArray:
    if wrap == "repeat" or number == 0:
        return values
    if wrap == "mirror":
        return np.flip(values, axis) if number % 2 else values
    if wrap == "black":
        return np.zeros_like(values)
    border = np.take(values, [0 if number < 0 else values.shape[axis] - 1], axis)
    return np.repeat(border, values.shape[axis], axis)
