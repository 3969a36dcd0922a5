"""A texture atlas by UV tiles, one for every triangle, whatever their number and neighbors.

A triangle of n cells a side takes one half of a square of n + 3 texels: its corners lie in the
centers of texels, and every texel that a bilinear lookup within it can read belongs to it alone.
The other half holds another triangle, rotated by 180 degrees. Triangles of one flat color share
four texels.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SIDES = tuple(sorted({*(1 << k for k in range(14)), *(3 << k for k in range(12))}))
"""Numbers of cells a side: 1, 2, 3, 4, 6, 8, 12, ...; few, so that most tiles find a partner."""

_GUTTER = 3
FLAT = 2
"""Width in texels of the square of a flat color."""


def cells_per_side(corners: NDArray[np.float64], density: float) -> NDArray[np.int64]:
    """Return the cells a side [F] of triangles with corners [F, 3, 3], the longest edge last.

    Args:
        corners: the first corner of each lies opposite the longest edge (`longest_edge_order`).
        density: cells per unit of length.
    """
    legs = np.linalg.norm(corners[:, 1:] - corners[:, :1], axis=2).max(axis=1)
    cells = np.ceil(legs * density - 1e-9).astype(np.int64)
    index = np.searchsorted(SIDES, np.clip(cells, 1, SIDES[-1]))
    return np.asarray(SIDES, np.int64)[index]


def longest_edge_order(corners: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the order [F, 3] of corners [F, 3, 3] that begins opposite the longest edge."""
    opposite = np.linalg.norm(np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1), axis=2)
    return (opposite.argmax(axis=1)[:, None] + np.arange(3)) % 3


def tile_weights(cells: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the texels [P, 2] (column, row) of a tile and their barycentric coordinates [P, 3].

    Texels beyond the longest edge show its nearest point.
    """
    column, row = np.meshgrid(np.arange(cells + 2), np.arange(cells + 2), indexing="xy")
    mine = column + row <= cells + 1
    texels = np.stack([column[mine], row[mine]], axis=1)
    inside = np.minimum(texels, cells)
    across = inside / np.maximum(inside.sum(axis=1, keepdims=True), cells)
    return texels, np.concatenate([1 - across.sum(axis=1, keepdims=True), across], axis=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Atlas:
    """Positions of tiles in a texture."""

    width: int
    height: int
    corner: NDArray[np.int64]
    """[K, 2] first texel (column, row) of each tile's square."""
    is_turned: NDArray[np.bool_]
    """[K] True where a tile is the half beyond the diagonal."""
    cells: NDArray[np.int64]
    """[K] cells a side of each tile; 0 for a flat color."""

    def texels(self, tile: int, tile_texels: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the atlas texels [P, 2] of a tile's texels [P, 2]."""
        last = self.cells[tile] + _GUTTER - 1
        return self.corner[tile] + (last - tile_texels if self.is_turned[tile] else tile_texels)

    def uv(self, tile: int) -> NDArray[np.float64]:
        """Return the texture coordinates [3, 2] of a tile's corners, v up."""
        cells = int(self.cells[tile])
        if cells == 0:
            at = np.broadcast_to(self.corner[tile] + FLAT / 2, (3, 2)).astype(np.float64)
        else:
            corners = np.array([[0, 0], [cells, 0], [0, cells]])
            at = self.texels(tile, corners).astype(np.float64) + 0.5
        return at / np.array([self.width, self.height])


def pack_atlas(cells: NDArray[np.int64]) -> Atlas:
    """Lay out tiles with the given cells a side [K], nearly square, in rows of squares."""
    order = np.argsort(-cells, kind="stable")
    squares, square_of, is_turned = _squares(cells, order)
    area = sum(side * side for side in squares)
    width = max([int(np.ceil(np.sqrt(area))), *squares[:1]])
    corners, height = _rows(squares, width)
    return Atlas(
        width=width,
        height=height,
        corner=corners[square_of],
        is_turned=is_turned,
        cells=cells,
    )


def _squares(
    cells: NDArray[np.int64], order: NDArray[np.int64]
) -> tuple[list[int], NDArray[np.int64], NDArray[np.bool_]]:
    """Return the widths of squares, and the square and half of each tile."""
    squares: list[int] = []
    square_of = np.zeros(len(cells), np.int64)
    is_turned = np.zeros(len(cells), np.bool_)
    half_free = 0  # cells of the tile that would fit into the last square
    for tile in order:
        count = int(cells[tile])
        if count and count == half_free:
            is_turned[tile] = True
            half_free = 0
        else:
            squares.append(count + _GUTTER if count else FLAT)
            half_free = count
        square_of[tile] = len(squares) - 1
    return squares, square_of, is_turned


def _rows(squares: Sequence[int], width: int) -> tuple[NDArray[np.int64], int]:
    """Return the first texel of each square, in rows from the largest, and the height."""
    corners = np.zeros((len(squares), 2), np.int64)
    x = y = tallest = 0
    for number, side in enumerate(squares):
        if x + side > width:
            x = 0
            y += tallest
            tallest = 0
        corners[number] = x, y
        x += side
        tallest = max(tallest, side)
    return corners, y + tallest
