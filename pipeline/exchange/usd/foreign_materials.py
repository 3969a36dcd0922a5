"""Converts USD materials to one row of material columns for each triangle.

Supported are UsdPreviewSurface in both workflows, and the constants of OpenPBR and Standard Surface
where a material has no preview. The BRDF of a scene has no Fresnel term: the specular albedo is the
head-on reflectance of the material, metals have no diffuse albedo, and the diffuse albedo is
lowered where both add up to more than 1. Coats, transparency and bumps are lost, with notes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.textured_triangles import NO_TEXTURES, TextureSet
from pipeline.exchange.usd.foreign_inputs import ShaderInputs, compute_varying_columns
from pipeline.exchange.usd.foreign_meshes import TriangleSoup
from pipeline.exchange.usd.foreign_uv_textures import CHANNELS, build_uv_textures
from pipeline.exchange.usd.held_materials import (
    HeldMaterial,
    choose_emission,
    choose_textures,
    name_lost_columns,
    parse_numbers,
    read_held_material,
    read_held_textures,
)
from pipeline.exchange.usd.names import added_column
from pipeline.foreign.usd.shaders import read_bindings, read_colors, read_material
from pipeline.foreign.usd.stage import OpenedStage
from storage.records.material import (
    DIFFUSE,
    EMISSION,
    ROUGHNESS,
    SPECULAR,
    default_rows,
    laid_out,
)
from storage.records.texture import TEXTURED, MapSource

_HELD = (
    "materials of Trilight are exact where nothing was changed; positions and normals are as this "
    "file has them, and the provenance is a new one"
)
_DEFAULT_DIFFUSE = (0.18, 0.18, 0.18)
_COLUMNS = {
    "diffuse": DIFFUSE,
    "specular": SPECULAR,
    "roughness": slice(ROUGHNESS, ROUGHNESS + 1),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceMaterials:
    """The materials and textures of the triangles of a mesh."""

    rows: NDArray[np.float32]
    """[T, 10 or more] material columns."""
    uv: NDArray[np.float32]
    """[T, 3, 2] texture coordinates of the corners."""
    texture_set_index: NDArray[np.int64]
    """[T] index of each triangle into `texture_sets`."""
    texture_sets: tuple[TextureSet, ...]
    """Texture set of each material bound to the mesh."""


def read_surface_materials(
    surface: TriangleSoup, time: Any, opened: OpenedStage, licence: str
) -> SurfaceMaterials:
    """Read the materials and textures of the triangles of a mesh.

    Args:
        surface: the mesh.
        time: time code of the values.
        opened: the open file, which collects notes on losses.
        licence: licence of its textures.

    Raises:
        TrilightError: a texture is outside the folder, on the network, or too large.
    """
    count = len(surface.positions)
    rows = default_rows(count)
    uv = np.zeros((count, 3, 2), np.float32)
    texture_sets = list[TextureSet]()
    texture_set_index = np.zeros(count, np.int64)
    for bound, polygons in read_bindings(surface.prim, time):
        chosen = np.isin(surface.cut.polygons, polygons) if polygons is not None else slice(None)
        part = _read_material_on_surface(bound, surface, time, opened, licence)
        rows[chosen] = part.rows[chosen]
        uv[chosen] = part.uv[chosen]
        texture_set_index[chosen] = len(texture_sets)
        texture_sets.append(part.texture_set)
    _limit_diffuse(rows, texture_set_index, texture_sets, surface, opened.lost)
    return SurfaceMaterials(
        rows=rows, uv=uv, texture_set_index=texture_set_index, texture_sets=tuple(texture_sets)
    )


def _limit_diffuse(
    rows: NDArray[np.float32],
    texture_set_index: NDArray[np.int64],
    texture_sets: Sequence[TextureSet],
    surface: TriangleSoup,
    lost: list[str],
) -> None:
    """Lower constant diffuse albedos where diffuse + specular is over 1."""
    is_plain = np.array([textures[:2] == (None, None) for textures in texture_sets])[
        texture_set_index
    ]
    excess = (rows[:, DIFFUSE] + rows[:, SPECULAR]).max(axis=1, initial=0) > 1 + 1e-6
    excess &= is_plain
    if excess.any():
        lost.append(
            f"{surface.prim.GetPath()}: diffuse lowered on {int(excess.sum())} triangles where "
            "diffuse + specular is over 1"
        )
        rows[excess, DIFFUSE] = np.minimum(rows[excess, DIFFUSE], 1 - rows[excess, SPECULAR])


@dataclass(frozen=True, kw_only=True, eq=False)
class _MaterialOnSurface:
    """One material evaluated on a whole mesh."""

    rows: NDArray[np.float32]  # [T, 10 or more]
    uv: NDArray[np.float32]  # [T, 3, 2]
    texture_set: TextureSet  # textures of the material


def _read_material_on_surface(
    material: Any, surface: TriangleSoup, time: Any, opened: OpenedStage, licence: str
) -> _MaterialOnSurface:
    """Evaluate a material on the whole mesh; the display color replaces a missing one."""
    held = read_held_material(material, time) if material else None
    known = () if held is None else ("specular",)  # Blender writes its specular level there
    stated = read_material(material, time, opened, known) if material else None
    if held is not None:
        opened.lost.append(_HELD)
    count = len(surface.positions)
    rows = default_rows(count)
    no_uv = np.zeros((count, 3, 2), np.float32)
    if stated is None:
        rows[:] = _build_plain_rows(material, held, surface, time, opened.lost)
        return _MaterialOnSurface(rows=rows, uv=no_uv, texture_set=NO_TEXTURES)
    inputs = ShaderInputs(stated, surface, time, opened)
    source = MapSource(name=stated.name, licence=licence)
    textures = {**read_held_textures(held, material, time, opened), **inputs.textures(CHANNELS)}
    mapped = build_uv_textures(textures, surface, time, source, opened.lost)
    where = f"{surface.prim.GetPath()}"
    resolved_textures = choose_textures(held, inputs, mapped.textures, source, where, opened.lost)
    for part, texture in zip((DIFFUSE, SPECULAR, ROUGHNESS), resolved_textures, strict=True):
        rows[:, part] = texture.mean if part != ROUGHNESS else texture.mean[0]
    rows[:, EMISSION] = choose_emission(held, inputs.emission(), opened.lost)
    varying = {
        name: texture if texture.constant is None else None
        for name, texture in zip(TEXTURED, resolved_textures, strict=True)
    }
    for name, column in compute_varying_columns(inputs, mapped.textures).items():
        rows[:, _COLUMNS[name]] = column
        varying[name] = None
    _take_added_columns(rows, material, time, opened.lost)
    if held is not None:
        opened.lost += name_lost_columns(material)
    return _MaterialOnSurface(
        rows=rows,
        uv=no_uv if mapped.uv is None else mapped.uv,
        texture_set=(varying["diffuse"], varying["specular"], varying["roughness"]),
    )


def _build_plain_rows(
    material: Any, held: HeldMaterial | None, surface: TriangleSoup, time: Any, lost: list[str]
) -> NDArray[np.float32]:
    """Return rows [T, 10 or more] of a material without a shader: held values or display colors."""
    rows = default_rows(len(surface.positions))
    if held is not None:
        lost.append(f"{material.GetPath()}: no shader; the values that Trilight wrote are used")
        rows[:] = held.row
        return rows
    if material:
        lost.append(f"{material.GetPath()}: no supported shader; its display color is used")
    rows[:, DIFFUSE] = _display_color(surface, time)
    rows[:, SPECULAR] = 0.04
    rows[:, ROUGHNESS] = 0.5
    return rows


def _take_added_columns(
    rows: NDArray[np.float32], material: Any, time: Any, lost: list[str]
) -> None:
    """Fill the columns beyond the published ones from the attributes that Trilight writes."""
    columns = {column.name: (column, part) for column, part in laid_out()}
    for attribute in material.GetPrim().GetAttributes():
        name = added_column(attribute.GetName())
        if name is None:
            continue
        if name not in columns:
            lost.append(f"{attribute.GetPath()}: this material column is not declared here")
            continue
        column, part = columns[name]
        value = parse_numbers(attribute.Get(time))
        if len(value) == column.width and np.all(column.within.holds(value)):
            rows[:, part] = value
        else:
            lost.append(
                f"{attribute.GetPath()}: expected {column.width} numbers {column.within}; "
                "the default is used"
            )


def _display_color(surface: TriangleSoup, time: Any) -> NDArray[np.float32]:
    rows = np.full((len(surface.positions), 3), _DEFAULT_DIFFUSE, np.float32)
    colors = read_colors(surface.cut, "displayColor", time)
    if colors is not None:
        rows = np.clip(colors.mean(axis=1), 0, 0.96).astype(np.float32)
    return rows
