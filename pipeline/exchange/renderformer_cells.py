"""Converts textures to the cells of RenderFormer's triangles, and cells to textures.

The layout is a right triangle in a square of 32 x 32 cells: the column x of a cell is the weight of
the first vertex and its row y that of the second, in 32nds, so that the third vertex is at the
corner x = y = 0. Version 1 wrote constants only; this is the layout of its successor, which fills
the same cells. A cell holds the mean of a texture over its area inside the triangle; cells beyond
the triangle continue the texture. When read, every triangle becomes a square of an atlas, with a
border of one cell so that no look-up touches a neighbor.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.linear_maps import color_textures, number_texture
from storage.records.lookup import texture_values
from storage.records.material import DIFFUSE, ROUGHNESS, SPECULAR, laid_out
from storage.records.scene import Scene
from storage.records.texture import CONSTANT, TEXTURED, MapSource, Texture

CELLS = 32
REFLECTED = 7
"""Number of channels that a material may have textured: two colors and a roughness."""

MAX_VARYING = 8192
"""Maximum number of triangles whose cells become an atlas; each takes 28 kB meanwhile."""

_BORDER = 1
_TILE = CELLS + 2 * _BORDER
_MOST_STEPS = 16  # maximum number of samples along the side of a cell


def filled_cell_mask() -> NDArray[np.bool_]:
    """Return a mask [32, 32] of the cells that hold a texture: those with x + y <= 32."""
    x, y = np.meshgrid(np.arange(CELLS), np.arange(CELLS))
    return x + y <= CELLS


def textured_triangles(scene: Scene) -> NDArray[np.bool_]:
    """Return a mask [T] of the triangles that have a texture and emit nothing."""
    if scene.material_textures is None:
        return np.zeros(scene.num_triangles, np.bool_)
    textured = (scene.material_textures != CONSTANT).any(axis=1)
    return np.asarray(textured[scene.material_index] & ~scene.triangle_emits)


def compute_cells(scene: Scene, triangle: int) -> list[tuple[slice, NDArray[np.float32]]]:
    """Return the channels and cells [C, 32, 32] of each textured column of a triangle."""
    assert scene.material_textures is not None and scene.uv is not None
    index = scene.material_textures[scene.material_index[triangle]]
    uv = scene.uv.reshape(-1, 3, 2)[triangle].astype(np.float64)
    column_slices = {column.name: part for column, part in laid_out()}
    return [
        (column_slices[name], _compute_means(scene.textures[row], uv))
        for name, row in zip(TEXTURED, index, strict=True)
        if row != CONSTANT
    ]


def _compute_means(texture: Texture, uv: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the means [C, 32, 32] of a texture over the cells of a triangle with corners [3, 2].

    Samples are as dense as the texels, up to 16 x 16 in a cell.
    """
    height, width = texture.texels.shape[:2]
    edges = (uv[:2] - uv[2]) * [width, height] / CELLS  # in texels, along a cell
    steps = int(np.clip(np.ceil(np.abs(edges).max()), 2, _MOST_STEPS))
    offsets = (np.arange(steps) + 0.5) / steps
    means = np.zeros((texture.channels, CELLS, CELLS), np.float32)
    x, y = np.meshgrid(np.arange(CELLS), np.arange(CELLS))
    for row in range(CELLS):  # one row of cells at a time: 131 k samples at most
        columns = x[row][filled_cell_mask()[row]]
        one = (columns[:, None, None] + offsets[None, None, :]) / CELLS
        two = (y[row][: len(columns), None, None] + offsets[None, :, None]) / CELLS
        one, two = np.broadcast_arrays(one, two)
        weights = np.stack([one, two, 1 - one - two], axis=-1)
        values = texture_values(texture, np.einsum("csuk,kd->csud", weights, uv))
        inside = (weights[..., 2] >= -1e-9) | ~(weights[..., 2] >= -1e-9).any((1, 2), keepdims=True)
        total = np.einsum("csu,csuk->ck", inside.astype(np.float64), values)
        means[:, row, : len(columns)] = (total / inside.sum(axis=(1, 2))[:, None]).T
    return means


def build_atlas(
    cells: NDArray[np.float32], source: MapSource
) -> tuple[tuple[Texture, Texture, Texture], NDArray[np.float32]]:
    """Return cells [N, 7, 32, 32] as textures of 8 bits: diffuse, specular and roughness.

    The second value has the texture coordinates [N, 3, 2] of the corners of each triangle.

    The diffuse albedo is lowered where both add up to more than 1. Cells that no look-up reaches
    get the mean of the others, so that a texture's mean is that of its triangles.
    """
    count = len(cells)
    across = int(np.ceil(np.sqrt(count)))
    up = -(-count // across)
    inner = np.moveaxis(np.clip(cells, 0, 1), 1, -1)
    means = inner[:, filled_cell_mask()].mean(axis=1)
    inner = np.where(filled_cell_mask()[..., None], inner, means[:, None, None])
    tiles = np.zeros((across * up, _TILE, _TILE, REFLECTED), np.float32) + means.mean(axis=0)
    tiles[:count] = np.pad(inner, ((0, 0), (_BORDER, _BORDER), (_BORDER, _BORDER), (0, 0)), "edge")
    sheet = tiles.reshape(up, across, _TILE, _TILE, REFLECTED).swapaxes(1, 2)
    sheet = sheet.reshape(up * _TILE, across * _TILE, REFLECTED)
    colors = color_textures(sheet[..., DIFFUSE], sheet[..., SPECULAR], source)
    roughness = number_texture(sheet[..., ROUGHNESS : ROUGHNESS + 1], source)
    row, column = np.divmod(np.arange(count), across)
    corner = np.stack([column, row], axis=-1)[:, None] * _TILE + _BORDER
    offsets = np.array([[CELLS, 0], [0, CELLS], [0, 0]])
    uv = (corner + offsets) / [across * _TILE, up * _TILE]
    return (*colors, roughness), uv.astype(np.float32)
