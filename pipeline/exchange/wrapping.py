"""Converts mirrored, clamped and black-bordered textures to textures that repeat.

Textures of a scene repeat along u and v; those of other formats may be mirrored in every second
tile, or continue as their border or as black. Over the finitely many tiles that a mesh uses, each
equals one picture: the tiles side by side, looked up at coordinates shifted and scaled to [0, 1].
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.picture import Wrap
from storage.records.exr import MAX_RESOLUTION
from storage.records.scene_maps import MAX_UV

MAX_TILES = 8
"""Maximum number of tiles along a side."""

_INSIDE = 1e-4
"""Tolerance for coordinates that leave [0, 1] by rounding."""


@dataclass(frozen=True, kw_only=True)
class Tiles:
    """Range of tiles along u or v that a picture covers."""

    first: int
    """Number of the first tile; tile 0 is [0, 1]."""
    count: int
    """Number of tiles from the first on."""


def choose_tiles(
    wraps: Sequence[Wrap], at: NDArray[np.floating], most_texels: int
) -> tuple[Tiles, bool]:
    """Return the tiles of one material's textures along an axis, and whether they suffice.

    One tile where all textures repeat, no coordinate leaves [0, 1], or too many would be needed.

    Args:
        wraps: wrap mode of each texture.
        at: coordinates of all corners along the axis.
        most_texels: maximum number of texels of a texture along the axis.
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
    first = int(np.floor(low))
    last = int(np.ceil(high))
    return Tiles(first=first, count=last - first)


def expand_tiles(values: NDArray, wrap: Wrap, tiles: Tiles, axis: int) -> NDArray:
    """Return the tiles of a picture [H, W, C] side by side along axis 0 (v) or 1 (u)."""
    tile_values = [
        _tile(values, wrap, number, axis)
        for number in range(tiles.first, tiles.first + tiles.count)
    ]
    return np.concatenate(tile_values, axis=axis) if len(tile_values) > 1 else tile_values[0]


def shift_near_zero(uv: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool]:
    """Return coordinates [T, 3, 2] within MAX_UV, and whether they look up the same texels.

    A triangle far out is shifted by whole periods of the texture.
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
