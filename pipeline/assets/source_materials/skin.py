"""Skins: a level's textures and emission, baked from the nearest source points, with their errors.

A triangle emits the mean of the source over it. Textures are an atlas by UV tiles, one for every
triangle, whatever their number and neighbors. A triangle of n cells a side takes one half of a
square of n + 3 texels: its corners lie in the centers of texels, and every texel that a bilinear
lookup within it can read belongs to it alone. The other half holds another triangle, rotated by 180
degrees. Triangles of one flat color share four texels.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray
from trimesh.graph import face_adjacency

from pipeline.assets.quality.measure import (
    Surface,
    level_mesh,
    round_digits,
    sample_surface,
    unit_normals,
)
from pipeline.assets.settings import AssetSettings, OwnMaterialSettings
from pipeline.assets.source_materials.source_surface import (
    FacePoints,
    SourceSurface,
    barycentric,
    match_source_surface,
)
from pipeline.foreign.gltf.materials import GltfMaterials
from pipeline.foreign.gltf.primitives import gltf_textured_mesh
from pipeline.foreign.material import TexturedMesh
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.mesh_materials import read_textured_mesh
from pipeline.foreign.picture import FilePictures, spread_points
from pipeline.foreign.source_file import SourceFile
from storage.conventions import linear_from_srgb8, srgb8
from storage.errors import Rejected, TrilightError
from storage.records.asset import Level, LevelSkin, OwnMaterials, SkinQuality
from storage.records.lookup import FLAT as FLAT_NORMAL
from storage.records.lookup import texture_values, unit_or_zero
from storage.records.packed_maps import pack_map
from storage.records.texture import NORMAL as NORMAL_MAP
from storage.records.texture import TEXTURED, Texture
from storage.seeds import rng_for

_SIDES = np.array(sorted({*(1 << k for k in range(14)), *(3 << k for k in range(12))}))
"""Numbers of cells a side: 1, 2, 3, 4, 6, 8, 12, ...; few, so that most tiles find a partner."""

_GUTTER = 3
FLAT = 2
"""Width in texels of the square of a flat color."""


def tile_weights(cells: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the texels [P, 2] (column, row) of a tile and their barycentric coordinates [P, 3].

    Texels beyond the longest edge show its nearest point; all are moved off the edges (`_INSET`).
    """
    column, row = np.meshgrid(np.arange(cells + 2), np.arange(cells + 2), indexing="xy")
    mine = column + row <= cells + 1
    texels = np.stack([column[mine], row[mine]], axis=1)
    inside = np.minimum(texels, cells)
    across = inside / np.maximum(inside.sum(axis=1, keepdims=True), cells)
    weights = np.concatenate([1 - across.sum(axis=1, keepdims=True), across], axis=1)
    part = min(_INSET, 0.25 / cells)
    return texels, (1 - part) * weights + part / 3


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

    def texels(self, tile: NDArray[np.int64], tile_texels: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the atlas texels [..., 2] of texels [..., 2] of tiles [...]."""
        last = (self.cells[tile] + _GUTTER - 1)[..., None]
        turned = self.is_turned[tile][..., None]
        return self.corner[tile] + np.where(turned, last - tile_texels, tile_texels)

    def uv(self, tile: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the texture coordinates [K, 3, 2] of the corners of tiles [K], v up."""
        cells = self.cells[tile][:, None, None]
        texels = self.texels(tile[:, None], cells * np.array([[0, 0], [1, 0], [0, 1]]))
        return (texels + np.where(cells == 0, FLAT / 2, 0.5)) / np.array([self.width, self.height])


def pack_atlas(cells: NDArray[np.int64]) -> Atlas:
    """Lay out tiles with the given cells a side [K], nearly square, in rows of squares.

    Squares come from the largest on; two tiles of equal size share one.
    """
    order = np.argsort(-cells, kind="stable")
    size = cells[order]
    rank = np.arange(len(size)) - np.searchsorted(-size, -size)  # among tiles of equal size
    turned = (rank % 2 == 1) & (size > 0)
    sides = np.where(size > 0, size + _GUTTER, FLAT)[~turned].tolist()
    width = max([int(np.ceil(np.sqrt(sum(side * side for side in sides)))), *sides[:1]])
    corners = []
    x = y = height = 0
    for side in sides:
        if x + side > width:
            x = 0
            y = height
        corners.append((x, y))
        x += side
        height = max(height, y + side)
    corner = np.zeros((len(cells), 2), np.int64)
    corner[order] = np.array(corners)[np.cumsum(~turned) - 1]
    is_turned = np.zeros(len(cells), np.bool_)
    is_turned[order] = turned
    return Atlas(width=width, height=height, corner=corner, is_turned=is_turned, cells=cells)


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
SLOPES = slice(7, 9)
"""Slices of the columns of the normal map, and of its x and y, where there is one."""
_LEAST_SLOPE = 1.5 / 255
"""Components of a normal that 8 bits take for a flat one, whichever of two codes stands for 0."""
_FLAT_CODE = np.round(255 * np.array(FLAT_NORMAL)).astype(np.uint8)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Texels:
    """The texels of all tiles, one tile after another."""

    start: NDArray[np.int64]  # [F + 1] first texel of each
    columns: NDArray[np.float64]  # [P, 7], or 10 with a normal map
    codes: NDArray[np.uint8]  # as they would be stored in 8 bits
    missed: float  # fraction of the texels without a source surface nearby
    density: float  # texels per unit of length


def _bake(
    level: TriangleMesh, source: SourceSurface, settings: OwnMaterialSettings, reach: float
) -> tuple[NDArray[np.float32], dict[str, Texture], _Texels]:
    """Return texture coordinates [F, 3, 2] of a level, v up, its textures and their texels.

    The textures have the names of TEXTURED; a normal map that is not flat comes with them.

    Args:
        level: mesh in the unit box.
        source: surface whose materials it shows.
        settings: texels and greatest size.
        reach: largest distance to the source, in the unit box.
    """
    edges = np.roll(level.corners, -2, axis=1) - np.roll(level.corners, -1, axis=1)
    opposite = np.linalg.norm(edges, axis=2).argmax(axis=1)  # of the longest edge
    order = ((opposite[:, None] + np.arange(3)) % 3)[..., None]
    corners = np.take_along_axis(level.corners, order, axis=1)
    legs = np.linalg.norm(corners[:, 1:] - corners[:, :1], axis=2).max(axis=1)
    density = float(settings.texels)
    while True:
        least = np.ceil(legs * density - 1e-9).astype(np.int64)
        cells = _SIDES[np.searchsorted(_SIDES, np.clip(least, 1, _SIDES[-1]))]
        plan = pack_atlas(cells)
        if max(plan.width, plan.height) <= settings.size or (cells == 1).all():
            break
        density *= _SHRINK
    texels = _bake_texels(corners, cells, source, reach, density)
    tile_of, first_of, is_flat = _tiles(texels)
    plan = pack_atlas(np.where(is_flat, 0, cells)[first_of])
    uv = np.zeros((len(corners), 3, 2), np.float32)
    np.put_along_axis(uv, order, plan.uv(tile_of), axis=1)
    return uv, _textures(_atlas_codes(plan, first_of, texels), texels), texels


def _bake_texels(
    corners: NDArray[np.float64],
    cells: NDArray[np.int64],
    source: SourceSurface,
    reach: float,
    density: float,
) -> _Texels:
    weights_of = {int(side): tile_weights(int(side))[1] for side in np.unique(cells)}
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
        locations, is_missed = source.find(points[part], normals[part], reach)
        columns[part, : NORMAL.start] = source.columns(locations, 1 / density)
        if source.has_normal_maps:
            mapped = source.normals(locations, 1 / density, (normals[part], along[part]))
            mapped[np.abs(mapped[:, :2]).max(axis=1) < _LEAST_SLOPE] = 0, 0, 1
            columns[part, NORMAL] = (mapped + 1) / 2
        missed += int(is_missed.sum())
    return _Texels(
        start=start,
        columns=columns,
        codes=_codes(columns),
        missed=missed / len(points),
        density=density,
    )


def _codes(columns: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return columns [..., 7 or 10] in 8 bits, diffuse ones sRGB-encoded."""
    numbers = np.round(columns[..., DIFFUSE.stop :] * 255).astype(np.uint8)
    return np.concatenate([srgb8(columns[..., DIFFUSE]), numbers], axis=-1)


def _has_flat_normals(codes: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return [N] True for rows of codes whose normal is flat, or that have none."""
    normals = codes[:, NORMAL]
    return (normals == _FLAT_CODE[: normals.shape[1]]).all(axis=1)


def _tiles(
    texels: _Texels,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return the tile [F] of each triangle, the first triangle [K] of each tile, and a mask [F].

    The mask is True where all texels of a triangle have the same 8-bit codes, and flat normals.
    Such triangles of the same color share a tile.
    """
    starts = texels.start[:-1]
    low = np.minimum.reduceat(texels.codes, starts, axis=0)
    high = np.maximum.reduceat(texels.codes, starts, axis=0)
    is_flat = (low == high).all(axis=1) & _has_flat_normals(low)
    number = np.where(is_flat, 0, 1 + np.arange(len(is_flat)))
    names = np.column_stack([number, np.where(is_flat[:, None], low, 0)])
    _, first, tile = np.unique(names, axis=0, return_index=True, return_inverse=True)
    return tile.ravel(), first, is_flat


def _atlas_codes(plan: Atlas, first_of: NDArray[np.int64], texels: _Texels) -> NDArray[np.uint8]:
    """Return the codes of the atlas, [H, W, 7 or 10]."""
    # Texels without a tile get a color of the object, for means over the map.
    codes = np.tile(texels.codes[0], (plan.height, plan.width, 1))
    for tile, face in enumerate(first_of):
        mine = slice(*texels.start[face : face + 2])
        cells = int(plan.cells[tile])
        if cells == 0:
            column, row = plan.corner[tile]
            flat = texels.columns[mine].mean(axis=0)
            codes[row : row + FLAT, column : column + FLAT] = _codes(flat)
            continue
        column, row = plan.texels(np.array(tile), tile_weights(cells)[0]).T
        codes[row, column] = texels.codes[mine]
        if plan.is_turned[tile]:  # and its frame with it
            codes[row, column, SLOPES] = np.round((1 - texels.columns[mine, SLOPES]) * 255)
    return codes


def _textures(codes: NDArray[np.uint8], texels: _Texels) -> dict[str, Texture]:
    """Return the maps in 8 bits; a constant map is one texel in float32."""
    constants = [_constant(texels, part) for part in _PARTS]
    stored = [codes[..., part] for part in _PARTS]
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
        textures[NORMAL_MAP] = Texture(texels=np.ascontiguousarray(codes[..., NORMAL]))
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

    Arguments as those of `_bake`.

    Raises:
        Rejected: materials_unreadable where the radiance is not a number, or too large for float32.
    """
    if not any(material.emits for material in source.parts.materials):
        return None
    weights = spread_points()
    corners = level.corners
    points = np.einsum("pc,fcd->fpd", weights, corners)
    normals = np.repeat(unit_normals(level), len(weights), axis=0)
    locations, _ = source.find(points.reshape(-1, 3), normals, reach)
    cell = float(np.sqrt(np.median(level.areas) / len(weights)))
    seen = source.emission(locations, cell).reshape(len(corners), -1, 3)
    mean = seen.mean(axis=1)
    if not mean.max() < _MOST:  # or not a number
        raise Rejected("materials_unreadable", f"a surface emits {mean.max():.3g}; < {_MOST:g}")
    brightness = mean.mean(axis=1)
    mean[brightness < _LEAST * brightness.max()] = 0
    return mean.astype(np.float32) if mean.any() else None


_LEAST_REACH = 1e-3
"""Least distance within which rays search the source, in the unit box; beyond it, 1.5 times the
level's largest error."""

_NUM_POINTS = 4096
"""Points on the source at which the color error is measured."""
_ALONG = (0.2, 0.5, 0.8)
"""Positions along an edge, as fractions, at which its two sides are compared."""
_TORN_TEXELS = 2.0
"""Gap in texels from which a seam counts as torn."""


def add_source_materials(
    levels: tuple[Level, ...],
    missed: Mapping[int, tuple[str, str]],
    source: SourceFile,
    clean: Surface,
    settings: AssetSettings,
) -> tuple[tuple[Level, ...], dict[int, tuple[str, str]], OwnMaterials | None]:
    """Return levels with skins, reasons of missing levels, and the state of the materials.

    Args:
        levels: levels without skins.
        missed: reason and message by budget.
        source: the object's file; `clean` is its clean, oriented mesh.
        settings: `own_materials` keeps materials, and says what happens where they are lost.

    Raises:
        Rejected: as `read_source_surface`, where `if_lost` is `reject`; transmissive_material,
            where `transmission` is.
    """
    reasons = dict(missed)
    if not settings.own_materials.keep:
        return levels, reasons, None
    refuse = settings.own_materials.if_lost == "reject"
    try:
        surface, materials = read_source_surface(source, clean, settings.own_materials)
    except Rejected as lost:
        if refuse:
            raise
        return levels, reasons, OwnMaterials(reason=lost.reason, message=lost.message)
    if settings.own_materials.transmission == "reject" and materials.see_through:
        raise Rejected(
            "transmissive_material",
            f"its materials have {' and '.join(materials.see_through)}; expected opaque ones, or "
            "own_materials.transmission=opaque",
        )
    with_skins = list[Level]()
    for level in levels:
        try:
            with_skins.append(add_skin(level, surface, settings.own_materials))
        except Rejected as lost:
            if refuse:
                reasons[level.record.budget] = (lost.reason, lost.message)
                continue
            with_skins.append(level)
            materials = OwnMaterials(reason=lost.reason, message=lost.message, lost=materials.lost)
    return tuple(with_skins), reasons, materials


def add_skin(level: Level, surface: SourceSurface, settings: OwnMaterialSettings) -> Level:
    """Return a level with its skin, which shows the materials of its source.

    Raises:
        Rejected: colours_changed or colours_missed where an error is over its limit, or
            materials_unreadable where no scene could hold the skin.
    """
    mesh = level_mesh(level)
    reach = max(_LEAST_REACH, 1.5 * level.record.quality.error_max * surface.mesh.diagonal)
    uv, textures, texels = _bake(mesh, surface, settings, reach)
    texel = 1 / texels.density
    # mean color differences at points spread evenly over the source
    uniform = rng_for(0, "own-materials").random((_NUM_POINTS, 3))
    points, source_faces = sample_surface(surface.mesh, uniform)
    at = FacePoints(source_faces, barycentric(surface.mesh.corners[source_faces], points))
    source_rgb = surface.columns(at, texel)[:, DIFFUSE]
    _, faces, nearest = igl.point_mesh_squared_distance(points, mesh.positions, mesh.faces)
    faces = np.asarray(faces, np.int64).ravel()
    places = np.einsum("nc,ncd->nd", barycentric(mesh.corners[faces], nearest), uv[faces])
    error = np.abs(texture_values(textures[TEXTURED[0]], places) - source_rgb).mean(axis=1)
    quality = SkinQuality(
        colour_error=round_digits(error.mean()),
        colour_error_p95=round_digits(np.percentile(error, 95)),
        missed_cells=round_digits(texels.missed),
        torn_seams=round_digits(_torn_seams(mesh, surface, reach, texel)),
        texels_per_length=round_digits(texels.density),
    )
    _require_near(quality, level.record.budget, settings)
    try:
        for column in TEXTURED:
            textures[column].check(column)
    except TrilightError as error_of_law:
        raise Rejected("materials_unreadable", str(error_of_law)) from error_of_law
    skin = LevelSkin(
        uv=uv,
        packed={name: pack_map(texture) for name, texture in textures.items()},
        quality=quality,
        emission=level_emission(mesh, surface, reach),
    )
    return dataclasses.replace(level, skin=skin)


def _require_near(quality: SkinQuality, budget: int, settings: OwnMaterialSettings) -> None:
    if quality.colour_error > settings.max_colour_error:
        raise Rejected(
            "colours_changed",
            f"colors are off by {quality.colour_error:.3f} on average at {budget} faces; "
            f"expected <= {settings.max_colour_error}",
        )
    if quality.missed_cells > settings.max_missed:
        raise Rejected(
            "colours_missed",
            f"{quality.missed_cells:.1%} of the texels have no surface of the source near at "
            f"{budget} faces; expected <= {settings.max_missed:.1%}",
        )


def read_source_surface(
    source: SourceFile, clean: Surface, settings: OwnMaterialSettings
) -> tuple[SourceSurface, OwnMaterials]:
    """Return the clean, oriented mesh of a source with its materials, and the lost ones.

    Raises:
        Rejected: no_materials, materials_unreadable, texture_missing, texture_outside,
            texture_too_large, texture_unreadable, no_texture_coordinates or
            texture_coordinates_not_finite.
    """
    pictures = FilePictures(settings.max_pixels)
    parts = _parts(source, pictures, settings)
    source.notes.extend(pictures.notes)
    lost = {word for material in parts.materials for word in material.lost}
    lost -= {"emission"} if settings.emission else set()
    return match_source_surface(clean, parts), OwnMaterials(lost=tuple(sorted(lost)))


def _parts(
    source: SourceFile, pictures: FilePictures, settings: OwnMaterialSettings
) -> TexturedMesh:
    emission = settings.emission
    normals = settings.normal_maps
    if source.usd is not None:  # whose normal maps its limits have chosen
        from pipeline.foreign.usd.materials import usd_textured_mesh  # slow to load

        return usd_textured_mesh(source.usd, pictures, emission=emission)
    if source.gltf is not None:
        materials = GltfMaterials(source.gltf, pictures, emission=emission, normals=normals)
        return gltf_textured_mesh(source.gltf, materials)
    return read_textured_mesh(source, pictures, emission=emission, normals=normals)


def _torn_seams(level: TriangleMesh, source: SourceSurface, reach: float, texel: float) -> float:
    """Return the fraction of inner edge length whose two sides show distant source points."""
    sides, ends = face_adjacency(level.faces, return_edges=True)
    if not len(sides):
        return 0.0
    inner = level.positions[ends]
    normal = unit_normals(level)
    along = np.array(_ALONG)[:, None, None]
    points = ((1 - along) * inner[:, 0] + along * inner[:, 1]).reshape(-1, 3)
    side_positions = []
    for side in sides.T:
        locations, _ = source.find(points, np.tile(normal[side], (len(_ALONG), 1)), reach)
        corners = source.mesh.corners[locations.faces]
        side_positions.append(np.einsum("nc,ncd->nd", locations.weights, corners))
    gap = np.linalg.norm(side_positions[0] - side_positions[1], axis=1).reshape(len(_ALONG), -1)
    length = np.linalg.norm(inner[:, 1] - inner[:, 0], axis=1)
    torn = (gap > _TORN_TEXELS * texel).mean(axis=0)
    return float((torn * length).sum() / length.sum())
