"""The textures of a material as UsdUVTexture shaders below it, and how its prims are connected.

A textured column of a material is an input of its UsdPreviewSurface that is connected to a texture,
which reads the coordinates `st` of the meshes. USD's coordinates are ours: v up, the bottom row of
a picture at v = 0. A textured material has no OpenPBR beside it: renderers of MaterialX then take
the preview, with its textures, instead of one colour. A specular texture is also that of the
roughness of a coat that is not there: Blender writes no specular texture, and keeps this one.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.exchange.usd.authoring import Attributes
from pipeline.exchange.usd.names import MAP_TEXTS, TEXTURE_ROW, format_map, texture_attribute
from pipeline.exchange.usd.texture_files import encode_texture, texture_file
from storage.records.scene import Scene
from storage.records.texture import CONSTANT, TEXTURED, Texture

PREVIEW, OPENPBR = "Preview", "OpenPBR"
"""Names of the two shaders of a material."""

SHADERS = {
    "diffuse": "DiffuseTexture",
    "specular": "SpecularTexture",
    "roughness": "RoughnessTexture",
}
"""Name of the texture's shader, by the column that it stands for."""

COORDINATES = "Coordinates"
"""Name of the shader that reads texture coordinates."""

ST = "primvars:st"
"""Attribute of the meshes of a textured scene."""

_INPUTS = {
    "diffuse": ("color3f", "inputs:diffuseColor", "outputs:rgb", "float3"),
    "specular": ("color3f", "inputs:specularColor", "outputs:rgb", "float3"),
    "roughness": ("float", "inputs:roughness", "outputs:r", "float"),
}
"""Of each column: type and name of the input, and name and type of the output that it reads."""

COAT_ROUGHNESS = "inputs:clearcoatRoughness"
"""Input of a preview without a coat that keeps the specular texture where others lose it."""

Used = Mapping[str, tuple[int, Texture]]
"""The textures of a material by the columns that they stand for, with their rows."""

Links = Mapping[str, tuple[str, str | None]]
"""Inputs and outputs by name: their type, and the output that each is connected to, if any."""


def used_textures(scene: Scene, row: int) -> Used:
    """Return the textures of a material row."""
    if scene.material_textures is None:
        return {}
    index = scene.material_textures[row].tolist()
    return {
        name: (texture, scene.textures[texture])
        for name, texture in zip(TEXTURED, index, strict=True)
        if texture != CONSTANT
    }


def texture_files(scene: Scene) -> dict[str, bytes]:
    """Return the files of the textures of a scene by their names; raises TrilightError."""
    return {texture_file(texture): encode_texture(texture) for texture in scene.textures}


def build_source_table(used: Used) -> Attributes:
    """Return the attributes of a material that say which textures it has."""
    return {
        texture_attribute(name): ("string", format_map(texture.sha256, texture.source))
        for name, (_, texture) in used.items()
    }


def texture_tables(used: Used) -> dict[str, Attributes]:
    """Return the attributes of the shaders of a material's textures, by their place below it."""
    tables = {
        f"/{SHADERS[name]}": _texture_table(row, texture) for name, (row, texture) in used.items()
    }
    if used:
        tables[f"/{COORDINATES}"] = {
            "info:id": ("uniform token", "UsdPrimvarReader_float2"),
            "inputs:varname": ("string", ST.removeprefix("primvars:")),
        }
    return tables


def material_links(textured: Sequence[str]) -> dict[str, Links]:
    """Return what the prims of a material are connected to, by their place below it.

    Args:
        textured: columns that have a texture.
    """
    surface: dict[str, tuple[str, str | None]] = {
        "outputs:surface": ("token", f"{PREVIEW}.outputs:surface")
    }
    preview: dict[str, tuple[str, str | None]] = {"outputs:surface": ("token", None)}
    places: dict[str, dict[str, tuple[str, str | None]]] = {"": surface, f"/{PREVIEW}": preview}
    if not textured:
        surface["outputs:mtlx:surface"] = ("token", f"{OPENPBR}.outputs:out")
        return {**places, f"/{OPENPBR}": {"outputs:out": ("token", None)}}
    for name in textured:
        kind, socket, output, output_kind = _INPUTS[name]
        preview[socket] = (kind, f"{SHADERS[name]}.{output}")
        shader = {
            output: (output_kind, None),
            "inputs:st": ("float2", f"{COORDINATES}.outputs:result"),
        }
        if name == "specular":
            preview[COAT_ROUGHNESS] = ("float", f"{SHADERS[name]}.outputs:r")
            shader["outputs:r"] = ("float", None)
        places[f"/{SHADERS[name]}"] = shader
    return {**places, f"/{COORDINATES}": {"outputs:result": ("float2", None)}}


def _texture_table(row: int, texture: Texture) -> Attributes:
    mean = tuple(float(value) for value in np.broadcast_to(texture.mean, 3))
    return {
        "info:id": ("uniform token", "UsdUVTexture"),
        "inputs:file": ("asset", f"./{texture_file(texture)}"),
        "inputs:sourceColorSpace": ("token", "sRGB" if texture.is_srgb else "raw"),
        "inputs:wrapS": ("token", "repeat"),
        "inputs:wrapT": ("token", "repeat"),
        "inputs:fallback": ("float4", (*mean, 1.0)),
        TEXTURE_ROW: ("int", row),
        **{name: ("string", getattr(texture.source, field)) for field, name in MAP_TEXTS.items()},
    }
