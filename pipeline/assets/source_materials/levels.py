"""Adds source materials to the levels of an asset, where settings keep them."""

from collections.abc import Mapping

from pipeline.assets.settings import AssetSettings
from pipeline.assets.source_materials.skin import SkinBaker, open_skin_baker
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.source_file import SourceFile
from storage.errors import Rejected
from storage.records.asset import Level
from storage.records.skin import OwnMaterials

Missed = dict[int, tuple[str, str]]


def add_source_materials(
    levels: tuple[Level, ...],
    missed: Mapping[int, tuple[str, str]],
    source: SourceFile,
    mesh: TriangleMesh,
    settings: AssetSettings,
) -> tuple[tuple[Level, ...], Missed, OwnMaterials | None]:
    """Return levels with skins, reasons of missing levels, and the state of the materials.

    Args:
        levels: levels without skins.
        missed: reason and message by budget.
        source: the object's file.
        mesh: the clean, oriented mesh of that file.
        settings: `own_materials` keeps materials, and says what happens where they are lost.

    Raises:
        Rejected: as `open_skin_baker`, where `if_lost` is `reject`.
    """
    material_settings = settings.own_materials
    if not material_settings.keep:
        return levels, dict(missed), None
    try:
        baker, materials = open_skin_baker(source, mesh, material_settings)
    except Rejected as lost:
        if material_settings.if_lost == "reject":
            raise
        return levels, dict(missed), OwnMaterials(reason=lost.reason, message=lost.message)
    return _add_skins(
        levels, missed, baker, materials, refuse=material_settings.if_lost == "reject"
    )


def _add_skins(
    levels: tuple[Level, ...],
    missed: Mapping[int, tuple[str, str]],
    baker: SkinBaker,
    materials: OwnMaterials,
    *,
    refuse: bool,
) -> tuple[tuple[Level, ...], Missed, OwnMaterials]:
    with_skins = list[Level]()
    reasons = dict(missed)
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
