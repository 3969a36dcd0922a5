"""What a USD material comes to here: one row of material columns a triangle.

UsdPreviewSurface in both workflows, and the constants of OpenPBR and Standard Surface where a
material has no preview. Our BRDF has no Fresnel term: the specular albedo is what such a material
reflects head-on, metals have no diffuse part, and the diffuse albedo gives way where both together
would reflect more than they get. Coats, transparency, bumps and textures finer than a triangle are
lost, and named.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.usd.foreign_meshes import TriangleSoup, per_corner
from pipeline.exchange.usd.foreign_textures import ForeignTexture, read_texture
from pipeline.exchange.usd.names import added_column
from pipeline.exchange.usd.stage import OpenedUsd
from storage.records.material import (
    DIFFUSE,
    EMISSION,
    REFLECTING,
    ROUGHNESS,
    SPECULAR,
    default_rows,
    laid_out,
)

_DEFAULT_DIFFUSE = (0.18, 0.18, 0.18)
_PREVIEW = "UsdPreviewSurface"
_NAMES = {
    _PREVIEW: {},
    "ND_open_pbr_surface_surfaceshader": {
        "diffuseColor": "base_color",
        "metallic": "base_metalness",
        "roughness": "specular_roughness",
        "ior": "specular_ior",
        "emissiveColor": "emission_color",
        "strength": "emission_luminance",
    },
    "ND_standard_surface_surfaceshader": {
        "diffuseColor": "base_color",
        "metallic": "metalness",
        "roughness": "specular_roughness",
        "ior": "specular_IOR",
        "emissiveColor": "emission_color",
        "strength": "emission",
    },
}
"""How shaders call what UsdPreviewSurface calls by the first name."""

_LOST = {
    "opacity": 1.0,
    "clearcoat": 0.0,
    "displacement": 0.0,
    "transmission_weight": 0.0,
    "transmission": 0.0,
    "coat_weight": 0.0,
    "coat": 0.0,
    "subsurface_weight": 0.0,
}
"""Inputs that have no place here, with the value at which they do nothing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshToShade:
    """A mesh whose triangles get materials."""

    prim: Any  # the mesh
    soup: TriangleSoup  # its triangles
    indices: NDArray[np.int64]  # point of each of its corners


def material_rows(surface: MeshToShade, time: Any, opened: OpenedUsd) -> NDArray[np.float32]:
    """Return the material row of each triangle of a mesh."""
    from pxr import UsdShade

    binding = UsdShade.MaterialBindingAPI(surface.prim)
    rows = default_rows(len(surface.soup.polygons))
    rows[:] = _shaded(binding.ComputeBoundMaterial()[0], surface, time, opened)
    for subset in binding.GetMaterialBindSubsets():
        chosen = np.isin(surface.soup.polygons, np.array(subset.GetIndicesAttr().Get(time) or []))
        bound = UsdShade.MaterialBindingAPI(subset.GetPrim()).ComputeBoundMaterial()[0]
        if bound:
            rows[chosen] = _shaded(bound, surface, time, opened)[chosen]
    excess = (rows[:, DIFFUSE] + rows[:, SPECULAR]).max(axis=1, initial=0) > 1 + 1e-6
    if excess.any():
        opened.lost.append(
            f"{surface.prim.GetPath()}: diffuse lowered on {int(excess.sum())} triangles that "
            "would reflect more than they get"
        )
        rows[:, DIFFUSE] = np.minimum(rows[:, DIFFUSE], 1 - rows[:, SPECULAR])
    return rows


def _shaded(
    material: Any, surface: MeshToShade, time: Any, opened: OpenedUsd
) -> NDArray[np.float32]:
    """Return rows of a material over the whole mesh; of its display colour without one."""
    shader = _shader(material, opened.lost) if material else None
    rows = default_rows(len(surface.soup.polygons))
    if shader is None:
        rows[:, DIFFUSE] = _display_colour(surface, time)
        rows[:, SPECULAR], rows[:, ROUGHNESS] = 0.04, 0.5
        return rows
    names = _NAMES[shader.GetShaderId()]

    def value(name: str, default: Any) -> NDArray[np.float32]:
        return _value(shader, names.get(name, name), default, surface, time, opened)

    base, metal = value("diffuseColor", _DEFAULT_DIFFUSE), value("metallic", 0.0)
    if value("useSpecularWorkflow", 0.0).any():
        rows[:, DIFFUSE], rows[:, SPECULAR] = base, value("specularColor", 0.0)
    else:
        ior = value("ior", 1.5)
        head_on = np.square((ior - 1) / np.maximum(ior + 1, 1e-3))
        rows[:, DIFFUSE] = base * (1 - metal)
        rows[:, SPECULAR] = head_on * (1 - metal) + base * metal
    rows[:, ROUGHNESS] = value("roughness", 0.5)[:, 0]
    rows[:, REFLECTING] = np.clip(rows[:, REFLECTING], 0, 1)
    strength = value("strength", 0.0) if "strength" in names else 1.0
    rows[:, EMISSION] = np.maximum(value("emissiveColor", 0.0) * strength, 0)
    _note_losses(shader, time, opened.lost)
    _take_added_columns(rows, material, time, opened.lost)
    return rows


def _take_added_columns(
    rows: NDArray[np.float32], material: Any, time: Any, lost: list[str]
) -> None:
    """Take the columns beyond the published ones from the attributes that Trilight writes."""
    places = {column.name: (column, part) for column, part in laid_out()}
    for attribute in material.GetPrim().GetAttributes():
        name = added_column(attribute.GetName())
        if name is None:
            continue
        if name not in places:
            lost.append(f"{attribute.GetPath()}: this material column is not declared here")
            continue
        column, part = places[name]
        value = _numbers(attribute.Get(time))
        if len(value) == column.width and np.all(column.within.holds(value)):
            rows[:, part] = value
        else:
            lost.append(
                f"{attribute.GetPath()}: expected {column.width} numbers {column.within}; "
                "the default taken"
            )


def _numbers(value: Any) -> NDArray[np.float64]:
    """Return what an attribute holds as a row of numbers; an empty one of anything else."""
    try:
        return np.array(value, np.float64).reshape(-1)
    except (TypeError, ValueError):
        return np.zeros(0)


def _shader(material: Any, lost: list[str]) -> Any:
    """Return the shader of a material that is understood, a preview before others."""
    found = None
    for context in ("", "mtlx"):
        source = material.ComputeSurfaceSource(context)[0]
        known = source and source.GetShaderId() in _NAMES
        if known and (found is None or source.GetShaderId() == _PREVIEW):
            found = source
    if found is None:
        lost.append(f"{material.GetPath()}: no shader that is understood; display colour taken")
    return found


def _value(
    shader: Any, name: str, default: Any, surface: MeshToShade, time: Any, opened: OpenedUsd
) -> NDArray[np.float32]:
    """Return an input for each triangle, [T, 3]; a single number stands in every column."""
    from pxr import UsdShade

    count = len(surface.soup.polygons)
    known = shader.GetInput(name)
    sources = UsdShade.Utils.GetValueProducingAttributes(known) if known else []
    if sources and UsdShade.Output.IsOutput(sources[0]):
        output = UsdShade.Output(sources[0])
        node = UsdShade.Shader(sources[0].GetPrim())
        if node.GetShaderId() == "UsdUVTexture":
            texture = read_texture(node, output.GetBaseName(), time, opened)
            found = None if texture is None else _textured(texture, name, surface, time, opened)
            if found is not None:
                return found
        opened.lost.append(
            f"{shader.GetPath()}.{name}: a network that is not read; {default} taken"
        )
        sources = []
    stated = sources[0].Get(time) if sources else None
    value = np.array(default if stated is None else stated, np.float32)
    if value.ndim > 1 or value.shape not in ((), (3,)) or not np.isfinite(value).all():
        opened.lost.append(
            f"{shader.GetPath()}.{name}: no finite number or colour; {default} taken"
        )
        value = np.array(default, np.float32)
    return np.broadcast_to(value, (count, 3)).astype(np.float32)


def _textured(
    texture: ForeignTexture, name: str, surface: MeshToShade, time: Any, opened: OpenedUsd
) -> NDArray[np.float32] | None:
    from pxr import UsdGeom

    primvar = UsdGeom.PrimvarsAPI(surface.prim).FindPrimvarWithInheritance(texture.primvar)
    if not primvar or not primvar.HasValue():
        return None
    values = np.array(primvar.ComputeFlattened(time), np.float64).reshape(-1, 2)
    uv = per_corner(values, str(primvar.GetInterpolation()), surface.indices, surface.soup)
    if uv is None:
        return None
    means, spread = texture.means(uv)
    opened.lost.append(
        f"{surface.prim.GetPath()}: texture of {name} became one value a triangle; texels lie "
        f"{spread:.3f} (root mean square, linear) from it"
    )
    return means


def _display_colour(surface: MeshToShade, time: Any) -> NDArray[np.float32]:
    from pxr import UsdGeom

    primvar = UsdGeom.PrimvarsAPI(surface.prim).FindPrimvarWithInheritance("displayColor")
    rows = np.full((len(surface.soup.polygons), 3), _DEFAULT_DIFFUSE, np.float32)
    if primvar and primvar.HasValue():
        values = np.array(primvar.ComputeFlattened(time), np.float32).reshape(-1, 3)
        interpolation = str(primvar.GetInterpolation())
        found = per_corner(values, interpolation, surface.indices, surface.soup)
        if found is not None:
            rows = np.clip(found.mean(axis=1), 0, 0.96).astype(np.float32)
    return rows


def _note_losses(shader: Any, time: Any, lost: list[str]) -> None:
    for name, neutral in _LOST.items():
        known = shader.GetInput(name)
        if known and (known.HasConnectedSource() or known.Get(time) not in (None, neutral)):
            lost.append(f"{shader.GetPath()}.{name}: has no place here")
    bump = shader.GetInput("normal")
    if bump and bump.HasConnectedSource():
        lost.append(f"{shader.GetPath()}.normal: bumps have no place here")
