"""Writes material rows to USD: exact attributes, UsdPreviewSurface, and OpenPBR for MaterialX.

The BRDF of a scene is Lambert + specular x GGX without a Fresnel term. UsdPreviewSurface in its
specular workflow has the same albedos and roughness, but its specular albedo rises to 1 at grazing
angles. Blender multiplies that albedo by the head-on reflectance of the index of refraction, which
other programs ignore; so the written index reflects almost everything. OpenPBR
(pipeline.exchange.usd.openpbr) looks similar too. Neither is equal; the attributes hold the exact
values. Textures are connected to the preview (pipeline.exchange.usd.write_textures).

UsdPreviewSurface counts emission as a plain color: it gets the radiance.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.usd.authoring import (
    Attributes,
    add_attributes,
    add_link,
    add_prim,
    usd_value,
)
from pipeline.exchange.usd.openpbr import Color, openpbr_inputs
from pipeline.exchange.usd.prim_names import (
    ADDED_COLUMNS,
    MATERIAL_ATTRIBUTES,
    column_attribute,
    material_name,
)
from pipeline.exchange.usd.write_textures import (
    OPENPBR,
    PREVIEW,
    Used,
    build_source_table,
    material_links,
    texture_tables,
    used_textures,
)
from pipeline.foreign.usd.shaders import IOR_OF_CONSTANT_ALBEDOS
from storage.records.material import (
    DIFFUSE,
    EMISSION,
    ROUGHNESS,
    SPECULAR,
    laid_out,
    stored_columns,
)
from storage.records.scene import Scene

PREVIEW_INPUTS = {
    "diffuse": "diffuseColor",
    "specular": "specularColor",
    "roughness": "roughness",
    "emission": "emissiveColor",
}
"""Input of the preview for each published column."""


def add_materials(layer: Any, folder: str, scene: Scene) -> None:
    """Write a prim for each material row below `folder`.

    Rows without textures are copies of the first such prim with other values, which takes half the
    time of writing each prim.
    """
    from pxr import Sdf

    add_prim(layer, folder, "Scope")
    first = None
    names = stored_columns(scene.materials)
    for row, values in enumerate(scene.materials):
        path = f"{folder}/{material_name(row)}"
        used = used_textures(scene, row)
        if used or first is None:
            _add_material(layer, path, material_tables(values, names, used), list(used))
            first = first if used else path
            continue
        Sdf.CopySpec(layer, first, layer, path)
        for relative_path, attributes in material_tables(values, names).items():
            prim = layer.GetPrimAtPath(path + relative_path)
            for name, (kind, value) in attributes.items():
                if kind in ("color3f", "float", "float[]"):
                    prim.attributes[name].default = usd_value(kind, value)


def material_tables(
    values: NDArray[np.float32], columns: Sequence[str], used: Used | None = None
) -> dict[str, Attributes]:
    """Return the attributes of a material row's prims, by their path below the material.

    Args:
        values: the row, with all declared columns.
        columns: names of the stored columns (storage.records.material.stored_columns).
        used: textures of the row; none by default.
    """
    diffuse, specular, emission = (_rgb(values[part]) for part in (DIFFUSE, SPECULAR, EMISSION))
    roughness = float(values[ROUGHNESS])
    tables: dict[str, Attributes] = {
        "": _exact_attributes(values, columns),
        f"/{PREVIEW}": {
            "info:id": ("uniform token", "UsdPreviewSurface"),
            "inputs:useSpecularWorkflow": ("int", 1),
            "inputs:diffuseColor": ("color3f", diffuse),
            "inputs:specularColor": ("color3f", specular),
            "inputs:roughness": ("float", roughness),
            "inputs:emissiveColor": ("color3f", emission),
            "inputs:ior": ("float", IOR_OF_CONSTANT_ALBEDOS),
        },
    }
    if used:
        tables[""] = {**tables[""], **build_source_table(used)}
        return {**tables, **texture_tables(used)}
    return {**tables, f"/{OPENPBR}": openpbr_inputs(diffuse, specular, roughness, emission)}


def _exact_attributes(values: NDArray[np.float32], columns: Sequence[str]) -> Attributes:
    """Return the attributes that hold the columns exactly."""
    attributes: dict[str, tuple[str, Any]] = {}
    for column, part in laid_out():
        if column.name in columns:
            kind = "color3f" if column.is_colour else "float" if column.width == 1 else "float[]"
            value = _rgb(values[part]) if column.is_colour else values[part]
            attributes[column_attribute(column.name)] = (
                kind,
                float(value[0]) if kind == "float" else value,
            )
    if added := [name for name in columns if name not in MATERIAL_ATTRIBUTES]:
        attributes[ADDED_COLUMNS] = ("string", " ".join(added))
    return attributes


def _add_material(
    layer: Any, path: str, tables: Mapping[str, Attributes], textured: Sequence[str]
) -> None:
    links = material_links(textured)
    for relative_path, attributes in tables.items():
        prim = add_prim(layer, path + relative_path, "Shader" if relative_path else "Material")
        add_attributes(prim, attributes)
        for name, (kind, source) in links[relative_path].items():
            add_link(prim, name, kind, None if source is None else f"{path}/{source}")


def _rgb(values: NDArray[np.float32]) -> Color:
    red, green, blue = (float(value) for value in values)
    return red, green, blue
