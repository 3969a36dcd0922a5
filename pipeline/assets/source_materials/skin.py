"""Source materials of one object, from its file to the skins of its levels."""

import dataclasses
from collections.abc import Mapping, Sequence

import igl
import numpy as np
from numpy.typing import NDArray

from pipeline.assets.quality.measure import (
    half_edges,
    level_mesh,
    round_digits,
    sample_surface,
    unit_normals,
)
from pipeline.assets.settings import AssetSettings, OwnMaterialSettings
from pipeline.assets.source_materials.bake import DIFFUSE, BakedTextures, bake, level_emission
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
from pipeline.foreign.numbers import FINITE
from pipeline.foreign.picture import Decode, Decoder
from pipeline.foreign.source_file import SourceFile
from storage.errors import Rejected, TrilightError
from storage.records.asset import Level, LevelSkin, OwnMaterials, SkinQuality
from storage.records.lookup import texture_values
from storage.records.packed_maps import pack_map
from storage.records.texture import NORMAL, TEXTURED, Texture
from storage.seeds import rng_for

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
    mesh: TriangleMesh,
    settings: AssetSettings,
) -> tuple[tuple[Level, ...], dict[int, tuple[str, str]], OwnMaterials | None]:
    """Return levels with skins, reasons of missing levels, and the state of the materials.

    Args:
        levels: levels without skins.
        missed: reason and message by budget.
        source: the object's file; `mesh` is its clean, oriented mesh.
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
        surface, materials = read_source_surface(source, mesh, settings.own_materials)
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
    baked = bake(mesh, surface, settings, reach)
    quality = skin_quality(mesh, baked, surface, reach)
    _require_near(quality, level.record.budget, settings)
    glow = level_emission(mesh, surface, reach)
    _require_lawful(baked.textures, glow)
    textures = dict(zip(TEXTURED, baked.textures, strict=True))
    if baked.normal is not None:
        textures[NORMAL] = baked.normal
    skin = LevelSkin(
        uv=baked.uv,
        packed={name: pack_map(texture) for name, texture in textures.items()},
        quality=quality,
        emission=glow,
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


def _require_lawful(textures: Sequence[Texture], emission: NDArray[np.float32] | None) -> None:
    try:
        for texture, column in zip(textures, TEXTURED, strict=True):
            texture.check(column)
    except TrilightError as error:
        raise Rejected("materials_unreadable", str(error)) from error
    if emission is not None and not FINITE.holds(emission).all():
        raise Rejected("materials_unreadable", f"it emits {emission.max()}; expected {FINITE}")


def read_source_surface(
    source: SourceFile, mesh: TriangleMesh, settings: OwnMaterialSettings
) -> tuple[SourceSurface, OwnMaterials]:
    """Return the clean, oriented mesh of a source with its materials, and the lost ones.

    Raises:
        Rejected: no_materials, materials_unreadable, texture_missing, texture_outside,
            texture_too_large, texture_unreadable, no_texture_coordinates or
            texture_coordinates_not_finite.
    """
    decode = Decoder(settings.max_pixels)
    parts = _parts(source, decode, settings)
    source.notes.extend(decode.notes)
    lost = {word for material in parts.materials for word in material.lost}
    lost -= {"emission"} if settings.emission else set()
    return match_source_surface(mesh, parts), OwnMaterials(lost=tuple(sorted(lost)))


def _parts(source: SourceFile, decode: Decode, settings: OwnMaterialSettings) -> TexturedMesh:
    emission = settings.emission
    normals = settings.normal_maps
    if source.usd is not None:  # whose normal maps its limits have chosen
        from pipeline.foreign.usd.materials import usd_textured_mesh  # slow to load

        return usd_textured_mesh(source.usd, decode, emission=emission)
    if source.gltf is not None:
        materials = GltfMaterials(source.gltf, decode, emission=emission, normals=normals)
        return gltf_textured_mesh(source.gltf, materials)
    return read_textured_mesh(source, decode, emission=emission, normals=normals)


def skin_quality(
    level: TriangleMesh, baked: BakedTextures, source: SourceSurface, reach: float
) -> SkinQuality:
    """Return the measures of a baked level; arguments as those of `bake`."""
    error = _color_errors(level, baked, source)
    return SkinQuality(
        colour_error=round_digits(error.mean()),
        colour_error_p95=round_digits(np.percentile(error, 95)),
        missed_cells=round_digits(baked.missed),
        torn_seams=round_digits(_torn_seams(level, source, reach, 1 / baked.density)),
        texels_per_length=round_digits(baked.density),
    )


def _color_errors(
    level: TriangleMesh, baked: BakedTextures, source: SourceSurface
) -> NDArray[np.float64]:
    """Return the mean color difference [N] at points spread evenly over the source."""
    uniform = rng_for(0, "own-materials").random((_NUM_POINTS, 3))
    points, point_faces = sample_surface(source.mesh, uniform)
    weights = barycentric(source.mesh.corners[point_faces], points)
    at = FacePoints(point_faces, weights)
    source_rgb = source.columns(at, 1 / baked.density)[:, DIFFUSE]
    _, faces, nearest = igl.point_mesh_squared_distance(points, level.positions, level.faces)
    faces = np.asarray(faces, np.int64).ravel()
    uv = np.einsum("nc,ncd->nd", barycentric(level.corners[faces], nearest), baked.uv[faces])
    level_rgb = texture_values(baked.textures[0], uv)
    return np.abs(level_rgb - source_rgb).mean(axis=1)


def _torn_seams(level: TriangleMesh, source: SourceSurface, reach: float, texel: float) -> float:
    """Return the fraction of inner edge length whose two sides show distant source points."""
    ends = np.sort(half_edges(level), axis=1)
    edges, edge, count = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    edge = edge.ravel()
    order = np.argsort(edge, kind="stable")
    sides = order[count[edge[order]] == 2].reshape(-1, 2) // 3
    if not len(sides):
        return 0.0
    inner = level.positions[edges[count == 2]]
    normal = unit_normals(level)
    along = np.array(_ALONG)[:, None, None]
    points = ((1 - along) * inner[:, 0] + along * inner[:, 1]).reshape(-1, 3)
    side_positions = []
    for side in sides.T:
        locations, _ = source.lookup.find(points, np.tile(normal[side], (len(_ALONG), 1)), reach)
        corners = source.mesh.corners[locations.faces]
        side_positions.append(np.einsum("nc,ncd->nd", locations.weights, corners))
    gap = np.linalg.norm(side_positions[0] - side_positions[1], axis=1).reshape(len(_ALONG), -1)
    length = np.linalg.norm(inner[:, 1] - inner[:, 0], axis=1)
    torn = (gap > _TORN_TEXELS * texel).mean(axis=0)
    return float((torn * length).sum() / length.sum())
