"""Bakes a level's textures and emission from the nearest source points.

A triangle emits the mean of the source over it. Textures are an atlas by UV tiles, one for every
triangle, whatever their number and neighbors. A triangle of n cells a side takes one half of a
square of n + 3 texels: its corners lie in the centers of texels, and every texel that a bilinear
lookup within it can read belongs to it alone. The other half holds another triangle, rotated by 180
degrees. Triangles of one flat color share four texels.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.quality.measure import unit_normals
from pipeline.assets.settings import OwnMaterialSettings
from pipeline.assets.source_materials.source_surface import SourceSurface
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.picture import spread_points
from storage.conventions import linear_from_srgb8, srgb8
from storage.errors import Rejected
from storage.records.lookup import FLAT as FLAT_NORMAL
from storage.records.lookup import unit_or_zero
from storage.records.texture import NORMAL as NORMAL_MAP
from storage.records.texture import TEXTURED, Texture

_SIDES = np.array(sorted({*(1 << k for k in range(14)), *(3 << k for k in range(12))}))
"""Numbers of cells a side: 1, 2, 3, 4, 6, 8, 12, ...; few, so that most tiles find a partner."""

_GUTTER = 3
FLAT = 2
"""Width in texels of the square of a flat color."""


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
    """Lay out tiles with the given cells a side [K], nearly square, in rows of squares.

    Squares come from the largest on; two tiles of equal size share one.
    """
    squares: list[int] = []
    square_of = np.zeros(len(cells), np.int64)
    is_turned = np.zeros(len(cells), np.bool_)
    half_free = 0  # cells of the tile that would fit into the last square
    for tile in np.argsort(-cells, kind="stable"):
        count = int(cells[tile])
        if count and count == half_free:
            is_turned[tile] = True
            half_free = 0
        else:
            squares.append(count + _GUTTER if count else FLAT)
            half_free = count
        square_of[tile] = len(squares) - 1
    area = sum(side * side for side in squares)
    width = max([int(np.ceil(np.sqrt(area))), *squares[:1]])
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
    return Atlas(
        width=width,
        height=y + tallest,
        corner=corners[square_of],
        is_turned=is_turned,
        cells=cells,
    )


_INSET = 0.02
"""Inset of texels on an edge, as a fraction of the way to their triangle's center: on the edge
itself, the neighbor would be as near. At most a quarter of a cell."""

_SHRINK = 0.9
"""Factor on the texel density per attempt, until the atlas fits its largest size."""
_BLOCK = 1 << 18
"""Texels per lookup; it bounds memory."""

_LEAST = 0.05
"""Fraction of the brightest triangle's radiance below which a triangle emits nothing."""
_MOST = 1e30
"""Radiance from which on a number is refused."""

DIFFUSE = slice(0, 3)
SPECULAR = slice(3, 6)
ROUGHNESS = slice(6, 7)
"""Slices of a texel's first columns, in the order of `material.source_columns`."""
NORMAL = slice(7, 10)
"""Slice of the columns of the normal map, where there is one."""
_LEAST_SLOPE = 1.5 / 255
"""Components of a normal that 8 bits take for a flat one, whichever of two codes stands for 0."""
_FLAT_CODE = np.round(255 * np.array(FLAT_NORMAL)).astype(np.uint8)


@dataclass(frozen=True, kw_only=True, eq=False)
class BakedTextures:
    """The textures of a level, before their quality is measured."""

    uv: NDArray[np.float32]
    """[F, 3, 2] texture coordinates of the corners, v up."""
    textures: Mapping[str, Texture]
    """Textures by the names of TEXTURED, and the normal map where it is not flat."""
    missed: float
    """Fraction of the texels without a source surface nearby."""
    density: float
    """Texels per unit of length."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Texels:
    """The texels of all tiles, one tile after another."""

    start: NDArray[np.int64]  # [F + 1] first texel of each
    columns: NDArray[np.float64]  # [P, 7], or 10 with a normal map
    codes: NDArray[np.uint8]  # as they would be stored in 8 bits
    missed: float


def bake(
    level: TriangleMesh, source: SourceSurface, settings: OwnMaterialSettings, reach: float
) -> BakedTextures:
    """Return the baked textures of a level.

    Args:
        level: mesh in the unit box.
        source: surface whose materials it shows.
        settings: texels and greatest size.
        reach: largest distance to the source, in the unit box.
    """
    order = longest_edge_order(level.corners)
    corners = np.take_along_axis(level.corners, order[..., None], axis=1)
    cells, density = _cells(corners, settings)
    texels = _bake_texels(corners, cells, source, reach, density)
    is_flat = _is_flat(texels)
    tile_of, first_of = _tiles(is_flat, texels)
    plan = pack_atlas(np.where(is_flat, 0, cells)[first_of])
    uv = np.zeros((len(corners), 3, 2))
    for face, tile in enumerate(tile_of):
        uv[face, order[face]] = plan.uv(int(tile))
    values = _atlas_values(plan, first_of, texels)
    return BakedTextures(
        uv=uv.astype(np.float32),
        textures=_textures(values, texels),
        missed=texels.missed,
        density=density,
    )


def _cells(
    corners: NDArray[np.float64], settings: OwnMaterialSettings
) -> tuple[NDArray[np.int64], float]:
    """Return the cells of each tile, and the density at which the atlas fits its size.

    The first corner of each triangle lies opposite its longest edge (`longest_edge_order`).
    """
    legs = np.linalg.norm(corners[:, 1:] - corners[:, :1], axis=2).max(axis=1)
    density = float(settings.texels)
    while True:
        least = np.ceil(legs * density - 1e-9).astype(np.int64)
        cells = _SIDES[np.searchsorted(_SIDES, np.clip(least, 1, _SIDES[-1]))]
        plan = pack_atlas(cells)
        if max(plan.width, plan.height) <= settings.size or (cells == 1).all():
            return cells, density
        density *= _SHRINK


def _bake_texels(
    corners: NDArray[np.float64],
    cells: NDArray[np.int64],
    source: SourceSurface,
    reach: float,
    density: float,
) -> _Texels:
    weights_of = {int(side): _inset(tile_weights(int(side))[1], side) for side in np.unique(cells)}
    counts = np.array([len(weights_of[int(side)]) for side in cells])
    start = np.concatenate([[0], np.cumsum(counts)])
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    points = np.concatenate(
        [weights_of[int(side)] @ corner for side, corner in zip(cells, corners, strict=True)]
    )
    normals = np.repeat(normal, counts, axis=0)
    edge = unit_or_zero(corners[:, 1] - corners[:, 0])  # u grows along it in tiles
    along = np.repeat(edge, counts, axis=0)
    columns = np.zeros((len(points), NORMAL.stop if source.has_normal_maps else NORMAL.start))
    missed = 0
    for first in range(0, len(points), _BLOCK):
        part = slice(first, first + _BLOCK)
        locations, is_missed = source.lookup.find(points[part], normals[part], reach)
        columns[part, : NORMAL.start] = source.columns(locations, 1 / density)
        if source.has_normal_maps:
            mapped = source.normals(locations, 1 / density, (normals[part], along[part]))
            mapped[np.abs(mapped[:, :2]).max(axis=1) < _LEAST_SLOPE] = 0, 0, 1
            columns[part, NORMAL] = (mapped + 1) / 2
        missed += int(is_missed.sum())
    codes = np.concatenate(
        [
            srgb8(columns[:, DIFFUSE]),
            np.round(columns[:, 3:] * 255).astype(np.uint8),
        ],
        axis=1,
    )
    return _Texels(start=start, columns=columns, codes=codes, missed=missed / len(points))


def _inset(weights: NDArray[np.float64], cells: np.integer) -> NDArray[np.float64]:
    part = min(_INSET, 0.25 / int(cells))
    return (1 - part) * weights + part / 3


def _is_flat(texels: _Texels) -> NDArray[np.bool_]:
    """Return [F] True where all texels of a tile have the same 8-bit codes, and flat normals."""
    starts = texels.start[:-1]
    low = np.minimum.reduceat(texels.codes, starts, axis=0)
    high = np.maximum.reduceat(texels.codes, starts, axis=0)
    return (low == high).all(axis=1) & _has_flat_normals(low)


def _has_flat_normals(codes: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return [N] True for rows of codes whose normal is flat, or that have none."""
    normals = codes[:, NORMAL]
    return (normals == _FLAT_CODE[: normals.shape[1]]).all(axis=1)


def _tiles(
    is_flat: NDArray[np.bool_], texels: _Texels
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the tile [F] of each triangle, and the first triangle [K] of each tile.

    Triangles of the same flat color share a tile.
    """
    codes = texels.codes[texels.start[:-1]].astype(np.int64)
    number = np.where(is_flat, 0, 1 + np.arange(len(is_flat)))
    names = np.column_stack([number, np.where(is_flat[:, None], codes, 0)])
    _, first, tile = np.unique(names, axis=0, return_index=True, return_inverse=True)
    return tile.ravel(), first


def _atlas_values(plan: Atlas, first_of: NDArray[np.int64], texels: _Texels) -> NDArray[np.float64]:
    """Return the columns of the atlas, [H, W, 7 or 10]."""
    values = np.zeros((plan.height, plan.width, texels.columns.shape[1]))
    # Texels without a tile get a color of the object, for means over the map.
    values[:] = texels.columns[0]
    for tile, face in enumerate(first_of):
        mine = slice(texels.start[face], texels.start[face + 1])
        column, row = plan.corner[tile]
        cells = int(plan.cells[tile])
        if cells == 0:
            square = slice(row, row + FLAT), slice(column, column + FLAT)
            values[square] = texels.columns[mine].mean(axis=0)
        else:
            at = plan.texels(tile, tile_weights(cells)[0])
            columns = texels.columns[mine].copy()
            if plan.is_turned[tile]:  # and its frame with it
                slopes = columns[:, NORMAL.start : NORMAL.start + 2]
                slopes[:] = 1 - slopes
            values[at[:, 1], at[:, 0]] = columns
    return values


def _textures(values: NDArray[np.float64], texels: _Texels) -> dict[str, Texture]:
    """Return the maps in 8 bits; a constant map is one texel in float32."""
    constants = [_constant(texels, part) for part in _PARTS]
    stored = [srgb8(values[..., DIFFUSE])]
    stored += [np.round(values[..., part] * 255).astype(np.uint8) for part in _PARTS[1:]]
    if constants[0] is None:
        specular = stored[1] / 255 if constants[1] is None else constants[1]
        stored[0] = _limit_diffuse(stored[0], specular)
    elif constants[1] is None:
        over = np.minimum(constants[0] + stored[1] / 255, 1) - constants[0]
        stored[1] = np.floor(over * 255 + 1e-6).astype(np.uint8)
    textures = {
        name: Texture(texels=np.ascontiguousarray(coded), is_srgb=name == TEXTURED[0])
        if constant is None
        else Texture(texels=constant[None, None])
        for name, coded, constant in zip(TEXTURED, stored, constants, strict=True)
    }
    if not _has_flat_normals(texels.codes).all():
        normal = np.round(values[..., NORMAL] * 255).astype(np.uint8)
        textures[NORMAL_MAP] = Texture(texels=normal)
    return textures


_PARTS = (DIFFUSE, SPECULAR, ROUGHNESS)


def _constant(texels: _Texels, part: slice) -> NDArray[np.float32] | None:
    """Return the value of a map whose texels all have equal 8-bit codes, or None."""
    columns = texels.columns[:, part]
    codes = texels.codes[:, part]
    if not (codes == codes[0]).all():
        return None
    same = (columns == columns[0]).all()
    return (columns[0] if same else columns.mean(axis=0)).astype(np.float32)


def _limit_diffuse(diffuse: NDArray[np.uint8], specular: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return diffuse sRGB codes whose sum with the specular albedo is at most 1 after rounding."""
    table = linear_from_srgb8()
    room = 1 + 1e-6 - np.broadcast_to(specular, diffuse.shape)
    highest = np.maximum(np.searchsorted(table, room, side="right") - 1, 0)
    return np.minimum(diffuse, highest).astype(np.uint8)


def level_emission(
    level: TriangleMesh, source: SourceSurface, reach: float
) -> NDArray[np.float32] | None:
    """Return the radiance [F, 3] of a level's triangles; None where nothing emits.

    Arguments as those of `bake`.

    Raises:
        Rejected: materials_unreadable where the radiance is not a number, or too large for float32.
    """
    if not source.emits:
        return None
    weights = spread_points()
    corners = level.corners
    points = np.einsum("pc,fcd->fpd", weights, corners)
    normals = np.repeat(unit_normals(level), len(weights), axis=0)
    locations, _ = source.lookup.find(points.reshape(-1, 3), normals, reach)
    cell = float(np.sqrt(np.median(level.areas) / len(weights)))
    seen = source.emission(locations, cell).reshape(len(corners), -1, 3)
    mean = seen.mean(axis=1)
    if not mean.max() < _MOST:  # or not a number
        raise Rejected("materials_unreadable", f"a surface emits {mean.max():.3g}; < {_MOST:g}")
    brightness = mean.mean(axis=1)
    mean[brightness < _LEAST * brightness.max()] = 0
    return mean.astype(np.float32) if mean.any() else None
