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

from storage.records.exr import MAX_RESOLUTION
from storage.records.scene_maps import MAX_UV

Wrap = Literal["repeat", "mirror", "clamp", "black"]

MAX_TILES = 8
"""Most tiles along a side."""

_INSIDE = 1e-4
"""How far coordinates may leave [0, 1] by rounding."""


@dataclass(frozen=True, kw_only=True)
class Tiles:
    """Which tiles along u or v a picture takes."""

    first: int
    """Number of the first tile; 0 is that of [0, 1]."""
    count: int
    """How many there are."""


def choose_tiles(
    wraps: Sequence[Wrap], at: NDArray[np.floating], most_texels: int
) -> tuple[Tiles, bool]:
    """Return the tiles that textures of one material need along an axis, and whether they suffice.

    One tile where all repeat, where no coordinate leaves [0, 1], or where it would be too many.

    Args:
        wraps: how each of them wraps.
        at: coordinates of all corners along the axis.
        most_texels: of any of them along the axis.
    """
    needed_tiles = _needed_tiles(wraps, at)
    if needed_tiles.count <= MAX_TILES and needed_tiles.count * most_texels <= MAX_RESOLUTION:
        return needed_tiles, True
    return Tiles(first=0, count=1), needed_tiles.count == 1


def _needed_tiles(wraps: Sequence[Wrap], at: NDArray[np.floating]) -> Tiles:
    low, high = (float(at.min()), float(at.max())) if at.size else (0.0, 1.0)
    modes = {wrap for wrap in wraps if wrap != "repeat"}
    if not modes or (low >= -_INSIDE and high <= 1 + _INSIDE):
        return Tiles(first=0, count=1)
    if modes == {"mirror"}:
        return Tiles(first=0, count=2)
    first, last = int(np.floor(low)), int(np.ceil(high))
    return Tiles(first=first, count=last - first)


def expand_tiles(values: NDArray, wrap: Wrap, tiles: Tiles, axis: int) -> NDArray:
    """Return a picture [H, W, C] side by side along an axis, 0 for v and 1 for u."""
    tile_values = [
        _tile(values, wrap, number, axis)
        for number in range(tiles.first, tiles.first + tiles.count)
    ]
    return np.concatenate(tile_values, axis=axis) if len(tile_values) > 1 else tile_values[0]


def shift_near_zero(uv: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool]:
    """Return coordinates [T, 3, 2] within the law of scenes, and whether they show the same.

    A triangle far out is moved by whole pictures, which repeat.
    """
    if not uv.size or np.abs(uv).max() <= MAX_UV:
        return uv, True
    near = uv - np.floor(uv.min(axis=1, keepdims=True))
    return np.clip(near, -MAX_UV, MAX_UV), bool(near.max() <= MAX_UV)


def _tile(values: NDArray, wrap: Wrap, number: int, axis: int) -> NDArray:
    if wrap == "repeat" or number == 0:
        return values
    if wrap == "mirror":
        return np.flip(values, axis) if number % 2 else values
    if wrap == "black":
        return np.zeros_like(values)
    border = np.take(values, [0 if number < 0 else values.shape[axis] - 1], axis)
    return np.repeat(border, values.shape[axis], axis)
