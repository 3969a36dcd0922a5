"""Source materials of one object, from its file to the skins of its levels."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.settings import AssetSettings, OwnMaterialSettings
from pipeline.assets.source_materials.bake import bake, level_emission
from pipeline.assets.source_materials.nearest import SurfaceLookup
from pipeline.assets.source_materials.source_surface import SourceSurface, match_source_surface
from pipeline.assets.source_materials.texture_quality import skin_quality
from pipeline.foreign.gltf.materials import GltfMaterials
from pipeline.foreign.gltf.objects import gltf_textured_mesh
from pipeline.foreign.material import TexturedMesh
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.mesh_materials import read_textured_mesh
from pipeline.foreign.numbers import FINITE
from pipeline.foreign.picture import Decode, Decoder
from pipeline.foreign.source_file import SourceFile
from pipeline.foreign.usd.materials import usd_textured_mesh
from storage.errors import Rejected, TrilightError
from storage.records.asset import Level
from storage.records.packed_maps import pack_texture
from storage.records.skin import LevelSkin, OwnMaterials, SkinQuality
from storage.records.texture import TEXTURED, Texture

_LEAST_REACH = 1e-3
"""Least distance within which rays search the source, in the unit box; beyond it, 1.5 times the
level's largest error."""


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
        Rejected: as `open_skin_baker`, where `if_lost` is `reject`; transmissive_material, where
            `transmission` is.
    """
    reasons = dict(missed)
    if not settings.own_materials.keep:
        return levels, reasons, None
    refuse = settings.own_materials.if_lost == "reject"
    try:
        baker, materials = open_skin_baker(source, mesh, settings.own_materials)
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
            with_skins.append(baker.add_skin(level))
        except Rejected as lost:
            if refuse:
                reasons[level.record.budget] = (lost.reason, lost.message)
                continue
            with_skins.append(level)
            materials = OwnMaterials(reason=lost.reason, message=lost.message, lost=materials.lost)
    return tuple(with_skins), reasons, materials


class SkinBaker:
    """Bakes the skins of the levels of one source."""

    def __init__(self, surface: SourceSurface, settings: OwnMaterialSettings) -> None:
        """Build the lookup of a source surface."""
        self._surface = surface
        self._settings = settings
        self._nearest = SurfaceLookup(surface.mesh)

    def add_skin(self, level: Level) -> Level:
        """Return a level with its skin.

        Raises:
            Rejected: colours_changed or colours_missed where an error is over its limit, or
                materials_unreadable where no scene could hold the skin.
        """
        mesh = TriangleMesh(
            positions=level.positions.astype(np.float64), faces=level.faces.astype(np.int64)
        )
        off = level.record.quality.error_max * self._surface.mesh.diagonal
        reach = max(_LEAST_REACH, 1.5 * off)
        baked = bake(mesh, self._surface, self._nearest, self._settings, reach)
        quality = skin_quality(mesh, baked, self._surface, self._nearest, reach)
        self._require_near(quality, level.record.budget)
        glow = level_emission(mesh, self._surface, self._nearest, reach)
        _require_lawful(baked.textures, glow)
        first, second, third = map(pack_texture, baked.textures)
        skin = LevelSkin(
            uv=baked.uv,
            packed=(first, second, third),
            packed_normal=None if baked.normal is None else pack_texture(baked.normal),
            quality=quality,
            emission=glow,
        )
        return dataclasses.replace(level, skin=skin)

    def _require_near(self, quality: SkinQuality, budget: int) -> None:
        if quality.colour_error > self._settings.max_colour_error:
            raise Rejected(
                "colours_changed",
                f"colors are off by {quality.colour_error:.3f} on average at {budget} faces; "
                f"expected <= {self._settings.max_colour_error}",
            )
        if quality.missed_cells > self._settings.max_missed:
            raise Rejected(
                "colours_missed",
                f"{quality.missed_cells:.1%} of the texels have no surface of the source near at "
                f"{budget} faces; expected <= {self._settings.max_missed:.1%}",
            )


def _require_lawful(textures: Sequence[Texture], emission: NDArray[np.float32] | None) -> None:
    try:
        for texture, column in zip(textures, TEXTURED, strict=True):
            texture.check(column)
    except TrilightError as error:
        raise Rejected("materials_unreadable", str(error)) from error
    if emission is not None and not FINITE.holds(emission).all():
        raise Rejected("materials_unreadable", f"it emits {emission.max()}; expected {FINITE}")


def open_skin_baker(
    source: SourceFile, mesh: TriangleMesh, settings: OwnMaterialSettings
) -> tuple[SkinBaker, OwnMaterials]:
    """Return the skin baker of a source with its clean, oriented mesh, and the lost materials.

    Raises:
        Rejected: no_materials, materials_unreadable, texture_missing, texture_outside,
            texture_too_large, texture_unreadable, no_texture_coordinates or
            texture_coordinates_not_finite.
    """
    decode = Decoder(settings.max_pixels)
    parts = _parts(source, decode, emission=settings.emission, normals=settings.normal_maps)
    source.notes.extend(decode.notes)
    lost = {word for material in parts.materials for word in material.lost}
    lost -= {"emission"} if settings.emission else set()
    surface = match_source_surface(mesh, parts)
    return SkinBaker(surface, settings), OwnMaterials(lost=tuple(sorted(lost)))


def _parts(
    source: SourceFile, decode: Decode, *, emission: bool, normals: bool = False
) -> TexturedMesh:
    if source.usd is not None:  # whose normal maps its limits have chosen
        return usd_textured_mesh(source.usd, decode, emission=emission)
    if source.gltf is not None:
        materials = GltfMaterials(source.gltf, decode, emission=emission, normals=normals)
        return gltf_textured_mesh(source.gltf, materials)
    return read_textured_mesh(source, decode, emission=emission, normals=normals)
