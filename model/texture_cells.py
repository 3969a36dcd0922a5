"""Coarse textures of triangles: means over the cells of a right triangle, for its token.

A triangle lies in the lower left half of a square of P x P cells. The column of a cell counts the
weight of vertex 0, its row that of vertex 1, and vertex 2 is the corner at the origin: the layout
of RenderFormer's texture input. A cell holds the mean of linear values over its part of the
triangle, of roughness as GGX width; cells beyond the longest side hold the mean of the triangle.

Cells follow the order of the vertices as it is, because rotary positions do: a network that knows
where vertex 0 stands knows where its cells lie. Training turns both together (`vertex_order`).
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.hits.textures import SurfaceTextures
from storage.records.lookup import texture_values
from storage.records.material import laid_out
from storage.records.texture import CONSTANT, TEXTURED, Texture

CHANNELS = 7
"""Diffuse 3, specular 3, roughness 1, in the order of TEXTURED."""

_PARTS = (slice(0, 3), slice(3, 6), slice(6, 7))
"""Where each of TEXTURED stands among the channels."""

_STEPS = (1, 2, 4)
"""Lookups along a side of a cell: as many as it has texels, and coarser texels beyond the last."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TextureCells:
    """Of the K textured triangles of a scene, or of a batch."""

    scene_K: Tensor
    """int64 row of the batch; 0 in a scene by itself."""
    triangle_K: Tensor
    """int64 row of the scene."""
    mean_KC: Tensor
    """Means over each triangle."""
    apart_KCPP: Tensor
    """What each cell holds beyond its triangle's mean; row, then column."""

    def converted(self, convert: Callable[[Tensor], Tensor]) -> "TextureCells":
        """Return the same with each tensor converted, such as moved to a device."""
        return TextureCells(
            scene_K=convert(self.scene_K).long(),
            triangle_K=convert(self.triangle_K).long(),
            mean_KC=convert(self.mean_KC),
            apart_KCPP=convert(self.apart_KCPP),
        )

    def means_in(self, material_BTM: Tensor, columns: tuple[str, ...]) -> Tensor:
        """Return material rows in which triangles have their own means."""
        found = material_BTM.clone()
        rows = found[self.scene_K, self.triangle_K]
        for column, part in laid_out(columns):
            if column.name in TEXTURED:
                rows[:, part] = self.mean_KC[:, _PARTS[TEXTURED.index(column.name)]].to(rows.dtype)
        found[self.scene_K, self.triangle_K] = rows
        return found


def texture_cells(
    textures: SurfaceTextures, materials_TC: NDArray[np.float32], cells_a_side: int
) -> TextureCells | None:
    """Return the cells of a scene, or None where every triangle's material is constant.

    Args:
        textures: of its T triangles.
        materials_TC: [T, 7] what their columns hold: means of textures, or constants.
        cells_a_side: P.
    """
    varied = np.array([texture.constant is None for texture in textures.textures] + [False])
    is_varied_T3 = varied[textures.rows_T3]  # CONSTANT is -1, which picks the last one
    rows = np.flatnonzero(is_varied_T3.any(axis=1))
    if not len(rows):
        return None
    mean_KC = materials_TC[rows].astype(np.float64)
    apart_KCL = np.zeros((len(rows), CHANNELS, cells_a_side**2))
    for place, part in enumerate(_PARTS):
        texture_K = np.where(is_varied_T3[rows, place], textures.rows_T3[rows, place], CONSTANT)
        for row in np.unique(texture_K[texture_K != CONSTANT]):
            some = np.flatnonzero(texture_K == row)
            texture = textures.textures[row]
            cells, means = _averaged(texture, textures.uv_T32[rows[some]], cells_a_side)
            if len(TEXTURED) - 1 == place:
                cells, means = np.sqrt(cells), np.sqrt(means)
            elif texture.channels == len(textures.channels):
                cells, means = (each[..., list(textures.channels)] for each in (cells, means))
            mean_KC[some, part] = means
            apart_KCL[some, part] = (cells - means[:, None]).swapaxes(1, 2)
    apart_KCL[:, :, _beyond(cells_a_side)] = 0
    apart_KCPP = apart_KCL.reshape(len(rows), CHANNELS, cells_a_side, cells_a_side)
    return TextureCells(
        scene_K=torch.zeros(len(rows), dtype=torch.int64),
        triangle_K=torch.from_numpy(rows.astype(np.int64)),
        mean_KC=torch.from_numpy(mean_KC.astype(np.float32)),
        apart_KCPP=torch.from_numpy(apart_KCPP.astype(np.float32)),
    )


def stack_cells(scenes: Sequence[TextureCells | None]) -> TextureCells | None:
    """Return the cells of a batch; None where no scene has any."""
    there = [
        dataclasses.replace(cells, scene_K=torch.full_like(cells.scene_K, row))
        for row, cells in enumerate(scenes)
        if cells is not None
    ]
    if not there:
        return None
    names = [each.name for each in dataclasses.fields(TextureCells)]
    return TextureCells(**{name: torch.cat([getattr(c, name) for c in there]) for name in names})


def _averaged(
    texture: Texture, uv_K32: NDArray[np.float32], cells_a_side: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return means over cells [K, P P, C] and over triangles [K, C]; of a number, of its square.

    Each triangle is looked up at as many places as its cells have texels, but for large ones: these
    read a map whose texels are larger, means of 2 x 2, 4 x 4 and so on.
    """
    maps = _coarser(texture)
    sides = np.array(texture.texels.shape[1::-1])
    edges = np.roll(uv_K32, -1, axis=1).astype(np.float64) - uv_K32
    across = np.linalg.norm(edges * sides, axis=-1).max(axis=-1) / cells_a_side
    steps_K = np.array(_STEPS)[np.searchsorted(_STEPS[:-1], across)]
    a, b = edges[:, 0] * sides, edges[:, 1] * sides
    texels = np.sqrt(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])) / (cells_a_side * _STEPS[-1])
    level_K = np.floor(np.log2(np.maximum(texels, 1))).astype(np.intp).clip(0, len(maps) - 1)
    level_K[steps_K < _STEPS[-1]] = 0
    cells = np.zeros((len(uv_K32), cells_a_side**2, texture.channels))
    means = np.zeros((len(uv_K32), texture.channels))
    for steps, level in np.unique(np.stack([steps_K, level_K], axis=-1), axis=0):
        some = np.flatnonzero((steps_K == steps) & (level_K == level))
        places = _places(cells_a_side, int(steps))
        uv = np.einsum("sv,kvi->ksi", places.weights_S3, uv_K32[some].astype(np.float64))
        values_KSC = texture_values(maps[level], uv)
        weighed_KSC = values_KSC * places.area_S[:, None]
        sums_KLC = np.add.reduceat(weighed_KSC, places.first_L, axis=1)
        areas_L = np.add.reduceat(places.area_S, places.first_L)
        cells[np.ix_(some, places.cell_L)] = sums_KLC / areas_L[:, None]
        means[some] = weighed_KSC.sum(axis=1) / areas_L.sum()
    return cells, means


def _coarser(texture: Texture) -> list[Texture]:
    """Return a texture in linear values, and maps of means over ever larger squares of its texels.

    A texture of a number is squared: a roughness is averaged as its GGX width.
    """
    values = texture.linear(texture.texels)
    if texture.channels == 1:
        values = np.square(values)
    maps = [Texture(texels=values)]
    while not any(side % 2 for side in values.shape[:2]):
        height, width, channels = values.shape
        fours = values.reshape(height // 2, 2, width // 2, 2, channels)
        values = fours.mean(axis=(1, 3), dtype=np.float32)
        maps.append(Texture(texels=values))
    return maps


@dataclass(frozen=True, kw_only=True, eq=False)
class _Places:
    """S places on a triangle, whose weighted means are exact for what is linear."""

    weights_S3: NDArray[np.float64]
    """Of the three vertices."""
    area_S: NDArray[np.float64]
    """What each stands for; those of a cell follow each other."""
    cell_L: NDArray[np.intp]
    """Cells that have places, row by row."""
    first_L: NDArray[np.intp]
    """First place of each."""


@cache
def _places(cells_a_side: int, steps: int) -> _Places:
    """Return the centres of the steps^2 parts of each cell.

    Of those that the longest side halves, the half within counts, by its centre.
    """
    count = cells_a_side * steps
    row, column = (each.ravel() for each in np.indices((count, count)))
    inside = np.flatnonzero(row + column < count)
    cell = row // steps * cells_a_side + column // steps
    inside = inside[np.argsort(cell[inside], kind="stable")]
    row, column, cell = row[inside], column[inside], cell[inside]
    is_half = row + column == count - 1
    offset, area = np.where(is_half, 1 / 3, 1 / 2), np.where(is_half, 0.5, 1.0)
    first, second = (column + offset) / count, (row + offset) / count
    cells, starts = np.unique(cell, return_index=True)
    return _Places(
        weights_S3=np.stack([first, second, 1 - first - second], axis=-1),
        area_S=area,
        cell_L=cells,
        first_L=starts,
    )


def _beyond(cells_a_side: int) -> NDArray[np.intp]:
    """Return the cells that lie beyond the longest side."""
    row, column = np.indices((cells_a_side, cells_a_side))
    return np.flatnonzero(row + column >= cells_a_side)
