"""Writes the textures of a material as UsdUVTexture shaders, and the connections of its prims.

A textured column of a material is an input of its UsdPreviewSurface that is connected to a texture,
which reads the coordinates `st` of the meshes. Coordinates need no conversion: v is up, and the
bottom row of a picture is at v = 0. A textured material has no OpenPBR shader, so that MaterialX
renderers use the preview with its textures instead of one color. A specular texture is also
connected to the roughness of an absent coat: Blender drops specular textures, but keeps this one.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.exchange.usd.authoring import Attributes
from pipeline.exchange.usd.names import MAP_TEXTS, TEXTURE_ROW, format_map, texture_attribute
from pipeline.exchange.usd.texture_files import encode_texture, texture_file
from storage.records.scene import Scene
from storage.records.texture import CONSTANT, TEXTURED, Texture

PREVIEW = "Preview"
OPENPBR = "OpenPBR"
"""Names of the two shaders of a material."""

SHADERS = {
    "diffuse": "DiffuseTexture",
    "specular": "SpecularTexture",
    "roughness": "RoughnessTexture",
}
"""Name of the texture shader of each column."""

COORDINATES = "Coordinates"
"""Name of the shader that reads texture coordinates."""

ST = "primvars:st"
"""Attribute of the meshes of a textured scene."""

_INPUTS = {
    "diffuse": ("color3f", "inputs:diffuseColor", "outputs:rgb", "float3"),
    "specular": ("color3f", "inputs:specularColor", "outputs:rgb", "float3"),
    "roughness": ("float", "inputs:roughness", "outputs:r", "float"),
}
"""Type and name of the input, and name and type of its output, by column."""

COAT_ROUGHNESS = "inputs:clearcoatRoughness"
"""Input of a preview without a coat; it preserves the specular texture in Blender."""

Used = Mapping[str, tuple[int, Texture]]
"""Row and texture of each textured column of a material."""

Links = Mapping[str, tuple[str, str | None]]
"""Type and connected output, if any, of each input and output by name."""


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
    """Return the texture files of a scene by name; raises TrilightError."""
    return {texture_file(texture): encode_texture(texture) for texture in scene.textures}


def build_source_table(used: Used) -> Attributes:
    """Return the attributes of a material that record its textures."""
    return {
        texture_attribute(name): ("string", format_map(texture.sha256, texture.source))
        for name, (_, texture) in used.items()
    }


def texture_tables(used: Used) -> dict[str, Attributes]:
    """Return the attributes of a material's texture shaders, by path below the material."""
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
    """Return the connections of a material's prims, by path below the material.

    Args:
        textured: names of the columns with a texture.
    """
    surface: dict[str, tuple[str, str | None]] = {
        "outputs:surface": ("token", f"{PREVIEW}.outputs:surface")
    }
    preview: dict[str, tuple[str, str | None]] = {"outputs:surface": ("token", None)}
    links: dict[str, dict[str, tuple[str, str | None]]] = {"": surface, f"/{PREVIEW}": preview}
    if not textured:
        surface["outputs:mtlx:surface"] = ("token", f"{OPENPBR}.outputs:out")
        return {**links, f"/{OPENPBR}": {"outputs:out": ("token", None)}}
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
        links[f"/{SHADERS[name]}"] = shader
    return {**links, f"/{COORDINATES}": {"outputs:result": ("float2", None)}}


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
