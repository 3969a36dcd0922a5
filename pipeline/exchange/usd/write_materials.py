"""A material row as USD: exact attributes, UsdPreviewSurface, and OpenPBR for MaterialX renderers.

Our BRDF is Lambert + specular x GGX without a Fresnel term. UsdPreviewSurface in its specular
workflow takes the same albedos and roughness, but lets its specular albedo rise to 1 at grazing
angles. OpenPBR's base has one index of refraction: it is chosen so that the strongest channel
reflects our specular albedo head-on, and the tint gives the others. So both look alike and neither
is equal; the exact values are in the attributes, which our Blender script reads.

OpenPBR counts emission in nits and UsdPreviewSurface as a plain colour: both get our radiance.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.usd.authoring import (
    Attributes,
    add_attributes,
    add_output,
    add_prim,
    usd_value,
)
from pipeline.exchange.usd.names import (
    column_attribute,
    material_name,
)
from storage.records.material import (
    DIFFUSE,
    EMISSION,
    ROUGHNESS,
    SPECULAR,
    laid_out,
    stored_columns,
)

PREVIEW, OPENPBR = "Preview", "OpenPBR"
"""Names of the two shaders of a material."""

_MOST_REFLECTING = 0.98
"""Head-on reflectance beyond which no index of refraction is sought: 0.98 needs 199."""


def add_materials(layer: Any, folder: str, materials: NDArray[np.float32]) -> None:
    """Write a prim for each material row below `folder`.

    Copies of the first prim get their values: that takes half the time of writing each anew.
    """
    from pxr import Sdf

    add_prim(layer, folder, "Scope")
    first = f"{folder}/{material_name(0)}"
    names = stored_columns(materials)
    for row, values in enumerate(materials):
        path = f"{folder}/{material_name(row)}"
        if row == 0:
            _add_material(layer, path, material_tables(values, names))
            continue
        Sdf.CopySpec(layer, first, layer, path)
        for place, attributes in material_tables(values, names).items():
            prim = layer.GetPrimAtPath(path + place)
            for name, (kind, value) in attributes.items():
                if kind in ("color3f", "float", "float[]"):
                    prim.attributes[name].default = usd_value(kind, value)


def material_tables(values: NDArray[np.float32], columns: Sequence[str]) -> dict[str, Attributes]:
    """Return the attributes of the prims of a material row, by their place below it.

    Args:
        values: the row, with all declared columns.
        columns: names of those that the file holds (storage.records.material.stored_columns).
    """
    diffuse, specular, emission = (_rgb(values[part]) for part in (DIFFUSE, SPECULAR, EMISSION))
    roughness = float(values[ROUGHNESS])
    head_on, luminance = max(specular), max(emission)
    root = math.sqrt(min(head_on, _MOST_REFLECTING))
    return {
        "": _exact(values, columns),
        f"/{PREVIEW}": {
            "info:id": ("uniform token", "UsdPreviewSurface"),
            "inputs:useSpecularWorkflow": ("int", 1),
            "inputs:diffuseColor": ("color3f", diffuse),
            "inputs:specularColor": ("color3f", specular),
            "inputs:roughness": ("float", roughness),
            "inputs:emissiveColor": ("color3f", emission),
        },
        f"/{OPENPBR}": {
            "info:id": ("uniform token", "ND_open_pbr_surface_surfaceshader"),
            "inputs:base_color": ("color3f", diffuse),
            "inputs:base_weight": ("float", 1.0),
            "inputs:base_diffuse_roughness": ("float", 0.0),
            "inputs:specular_weight": ("float", 1.0 if head_on > 0 else 0.0),
            "inputs:specular_color": ("color3f", _share(specular, head_on)),
            "inputs:specular_roughness": ("float", roughness),
            "inputs:specular_ior": ("float", _single((1 + root) / (1 - root))),
            "inputs:emission_luminance": ("float", luminance),
            "inputs:emission_color": ("color3f", _share(emission, luminance)),
        },
    }


def _exact(values: NDArray[np.float32], columns: Sequence[str]) -> Attributes:
    """Return the attributes that hold the columns exactly."""
    found: dict[str, tuple[str, Any]] = {}
    for column, part in laid_out():
        if column.name in columns:
            kind = "color3f" if column.is_colour else "float" if column.width == 1 else "float[]"
            value = _rgb(values[part]) if column.is_colour else values[part]
            found[column_attribute(column.name)] = (
                kind,
                float(value[0]) if kind == "float" else value,
            )
    return found


def _add_material(layer: Any, path: str, tables: Mapping[str, Attributes]) -> None:
    for place, attributes in tables.items():
        prim = add_prim(layer, path + place, "Shader" if place else "Material")
        add_attributes(prim, attributes)
        if place:
            add_output(prim, "outputs:surface" if place == f"/{PREVIEW}" else "outputs:out")
        else:
            add_output(prim, "outputs:surface", f"{path}/{PREVIEW}.outputs:surface")
            add_output(prim, "outputs:mtlx:surface", f"{path}/{OPENPBR}.outputs:out")


def _rgb(values: NDArray[np.float32]) -> tuple[float, float, float]:
    red, green, blue = (float(value) for value in values)
    return red, green, blue


def _share(rgb: tuple[float, float, float], largest: float) -> tuple[float, float, float]:
    """Return a colour divided by its largest channel; white for black."""
    if largest <= 0:
        return 1.0, 1.0, 1.0
    red, green, blue = (_single(value / largest) for value in rgb)
    return red, green, blue


def _single(value: float) -> float:
    return float(np.float32(value))
