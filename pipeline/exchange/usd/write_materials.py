"""Writes material rows to USD: exact attributes, UsdPreviewSurface, and OpenPBR or textures.

The BRDF of a scene is Lambert + specular x GGX without a Fresnel term. UsdPreviewSurface in its
specular workflow has the same albedos and roughness, but its specular albedo rises to 1 at grazing
angles. Blender multiplies that albedo by the head-on reflectance of the index of refraction, which
other programs ignore; so the written index reflects almost everything. OpenPBR's base has one index
of refraction: it is set so that the strongest channel reflects the specular albedo head-on, and the
tint gives the other channels. Neither is equal; the attributes hold the exact values. Both count
emission otherwise (as a plain color, in nits) and get the radiance.

A textured column is an input of the preview that is connected to a texture, which reads the
coordinates `st` of the meshes. Coordinates need no conversion: v is up, and the bottom row of a
picture is at v = 0. A textured material has no OpenPBR shader, so that MaterialX renderers use the
preview with its textures instead of one color. A specular texture is also connected to the
roughness of an absent coat: Blender drops specular textures, but keeps this one.

The file of a texture is lossless: PNG for 8 bits, OpenEXR for float32, with one channel or three.
Picture files begin with the top row, textures of a scene with the bottom row. Equal textures share
a file.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.documents.png import encode_png
from pipeline.exchange.textured_triangles import used_textures
from pipeline.exchange.usd import layout
from pipeline.foreign.picture import MAX_PIXELS, decode_image
from pipeline.foreign.usd.shaders import IOR_OF_CONSTANT_ALBEDOS
from storage.errors import Rejected, TrilightError
from storage.records.exr import MAGIC, MAX_RESOLUTION, decode_channels, encode_channels
from storage.records.material import column_places, laid_out, stored_columns
from storage.records.scene import Scene
from storage.records.texture import NORMAL, TEXTURED, Environment, MapSource, Texture

PREVIEW = "Preview"
OPENPBR = "OpenPBR"
"""Names of the two shaders of a material."""

PREVIEW_INPUTS = {
    "diffuse": "diffuseColor",
    "specular": "specularColor",
    "roughness": "roughness",
    "emission": "emissiveColor",
}
"""Input of the preview for each published column."""

SHADERS = {name: f"{name.capitalize()}Texture" for name in (*TEXTURED, NORMAL)}
"""Name of the texture shader of each column, and of the normal map."""

ST = "primvars:st"
"""Attribute of the meshes of a textured scene."""

COAT_ROUGHNESS = "inputs:clearcoatRoughness"
"""Input of a preview without a coat; it preserves the specular texture in Blender."""

_COORDINATES = "Coordinates"
"""Name of the shader that reads texture coordinates."""

_LINKS = {
    "diffuse": ("color3f", "inputs:diffuseColor", "outputs:rgb", "float3"),
    "specular": ("color3f", "inputs:specularColor", "outputs:rgb", "float3"),
    "roughness": ("float", "inputs:roughness", "outputs:r", "float"),
    NORMAL: ("normal3f", "inputs:normal", "outputs:rgb", "float3"),
}
"""Type and name of the input, and name and type of its output, by column."""

_TO_VECTORS: layout.Attributes = {
    "inputs:scale": ("float4", (2.0, 2.0, 2.0, 1.0)),
    "inputs:bias": ("float4", (-1.0, -1.0, -1.0, 0.0)),
    "inputs:fallback": ("float4", (0.0, 0.0, 1.0, 1.0)),
}
"""Inputs that make vectors of the texels of a normal map."""

_CHANNELS = {1: "Y", 3: "RGB"}
"""OpenEXR channel names by channel count: a number or a color."""

Used = Mapping[str, tuple[int, Texture]]
"""Row and texture of each textured column of a material, and of its normal map."""

_Table = dict[str, tuple[str, Any] | tuple[str, Any, str]]

OPENPBR_SHADER = "ND_open_pbr_surface_surfaceshader"

_MOST_REFLECTING = 0.98
"""Maximum head-on reflectance that sets the index of refraction: 0.98 needs 199."""


def add_materials(layer: Any, folder: str, scene: Scene) -> None:
    """Write a prim for each material row below `folder`.

    No row is a copy of another: Sdf.CopySpec orders fields by the addresses of their names, so that
    the bytes of a file would differ between processes.
    """
    layout.add_prim(layer, folder, "Scope")
    columns = stored_columns(scene.materials)
    for row, values in enumerate(scene.materials):
        path = f"{folder}/{layout.material_name(row)}"
        tables = material_tables(values, columns, used_textures(scene, row))
        for below, attributes in tables.items():
            prim = layout.add_prim(layer, path + below, "Shader" if below else "Material")
            layout.add_attributes(prim, attributes, path)


def material_tables(
    values: NDArray[np.float32], columns: Sequence[str], used: Used
) -> dict[str, layout.Attributes]:
    """Return the attributes of a material row's prims, by their path below the material.

    The row has all declared columns; `columns` names the stored ones, and `used` its textures.
    """
    stated = {name: values[part].tolist() for name, part in column_places().items()}
    material = _exact_attributes(values, columns)
    for name, (_, texture) in used.items():
        source = layout.format_map(texture.sha256, texture.source)
        material[layout.TEXTURE_SOURCE + name] = ("string", source)
    material["outputs:surface"] = ("token", None, f"{PREVIEW}.outputs:surface")
    preview: _Table = {
        "info:id": ("uniform token", "UsdPreviewSurface"),
        "inputs:useSpecularWorkflow": ("int", 1),
        "inputs:diffuseColor": ("color3f", stated["diffuse"]),
        "inputs:specularColor": ("color3f", stated["specular"]),
        "inputs:roughness": ("float", stated["roughness"][0]),
        "inputs:emissiveColor": ("color3f", stated["emission"]),
        "inputs:ior": ("float", IOR_OF_CONSTANT_ALBEDOS),
        "outputs:surface": ("token", None),
    }
    tables: dict[str, layout.Attributes] = {"": material, f"/{PREVIEW}": preview}
    if not used:
        material["outputs:mtlx:surface"] = ("token", None, f"{OPENPBR}.outputs:out")
        tables[f"/{OPENPBR}"] = {**openpbr_inputs(stated), "outputs:out": ("token", None)}
        return tables
    for name, (row, texture) in used.items():
        kind, socket, output, output_kind = _LINKS[name]
        value = preview[socket][1] if socket in preview else None
        preview[socket] = (kind, value, f"{SHADERS[name]}.{output}")
        shader = {
            **_texture_table(row, texture),
            **(_TO_VECTORS if name == NORMAL else {}),
            output: (output_kind, None),
            "inputs:st": ("float2", None, f"{_COORDINATES}.outputs:result"),
        }
        if name == "specular":
            preview[COAT_ROUGHNESS] = ("float", None, f"{SHADERS[name]}.outputs:r")
            shader["outputs:r"] = ("float", None)
        tables[f"/{SHADERS[name]}"] = shader
    tables[f"/{_COORDINATES}"] = {
        "info:id": ("uniform token", "UsdPrimvarReader_float2"),
        "inputs:varname": ("string", ST.removeprefix("primvars:")),
        "outputs:result": ("float2", None),
    }
    return tables


def _exact_attributes(values: NDArray[np.float32], columns: Sequence[str]) -> _Table:
    """Return the attributes that hold the columns exactly."""
    attributes: _Table = {}
    for column, part in laid_out():
        if column.name in columns:
            kind = "color3f" if column.is_colour else "float" if column.width == 1 else "float[]"
            value = values[part].tolist() if column.is_colour else values[part]
            attributes[layout.column_attribute(column.name)] = (
                kind,
                float(value[0]) if kind == "float" else value,
            )
    if added := [name for name in columns if name not in layout.MATERIAL_ATTRIBUTES]:
        attributes[layout.ADDED_COLUMNS] = ("string", " ".join(added))
    return attributes


def _texture_table(row: int, texture: Texture) -> _Table:
    mean = tuple(float(value) for value in np.broadcast_to(texture.mean, 3))
    return {
        "info:id": ("uniform token", "UsdUVTexture"),
        "inputs:file": ("asset", f"./{texture_file(texture)}"),
        "inputs:sourceColorSpace": ("token", "sRGB" if texture.is_srgb else "raw"),
        "inputs:wrapS": ("token", "repeat"),
        "inputs:wrapT": ("token", "repeat"),
        "inputs:fallback": ("float4", (*mean, 1.0)),
        layout.TEXTURE_ROW: ("int", row),
        **layout.text_attributes(layout.MAP_TEXTS, texture.source),
    }


def map_files(scene: Scene) -> dict[str, bytes]:
    """Return the files of the textures and the sky of a scene by name; raises TrilightError."""
    files = {
        texture_file(texture): _encode_map(texture.texels[::-1], "texture")
        for texture in scene.textures
    }
    if (sky := scene.environment) is not None:
        files[sky_file(sky)] = _encode_map(sky.radiance_rgb, "environment")
    return files


def texture_file(texture: Texture) -> str:
    """Return the file name of a texture."""
    suffix = "png" if texture.texels.dtype == np.uint8 else "exr"
    return f"texture-{texture.sha256[:16]}.{suffix}"


def sky_file(sky: Environment) -> str:
    """Return the file name of a map; equal maps share a file."""
    return f"sky-{sky.sha256[:16]}.exr"


def _encode_map(texels: NDArray[Any], what: str) -> bytes:
    """Return the bytes of a picture [H, W, C], the top row first; they contain no time stamp.

    Raises:
        TrilightError: the picture, which the message calls `what`, is larger than the USD reader
            accepts.
    """
    height, width, channels = texels.shape
    if max(height, width) > MAX_RESOLUTION:
        raise TrilightError(
            f"{what}: {width} x {height} texels; expected at most {MAX_RESOLUTION} each way in "
            "USD. Write it as .safetensors, or make it smaller."
        )
    picture = np.ascontiguousarray(texels if channels == 3 else texels[..., 0])
    if picture.dtype == np.float32:
        return encode_channels({_CHANNELS[channels]: picture})
    return encode_png(picture)


def decode_texture(
    data: bytes, name: str, column: str, *, is_srgb: bool, source: MapSource
) -> Texture:
    """Decode the file of the texture of a material's column, or of its normal map.

    Raises:
        LookupError: `map_files` did not write the file.
    """
    channels = 1 if column == "roughness" else 3
    is_exr = data.startswith(MAGIC)
    try:
        if is_exr:
            pixels = decode_channels(data, _CHANNELS[channels])[_CHANNELS[channels]]
            texels = pixels.reshape(*pixels.shape[:2], -1)[::-1]
        else:
            texels = decode_image(data, name, MAX_PIXELS, [])[..., :channels]
        is_encoded = is_srgb and not is_exr
        texels = np.ascontiguousarray(texels)
        texture = Texture(texels=texels, is_srgb=is_encoded, source=source)
        texture.check("texture")
    except (TrilightError, Rejected) as error:
        raise LookupError("it is no texture that was written here") from error
    return texture


def openpbr_inputs(columns: Mapping[str, Sequence[float]]) -> layout.Attributes:
    """Return the attributes of the shader of a material's columns."""
    specular = columns["specular"]
    emission = columns["emission"]
    root = math.sqrt(min(max(specular), _MOST_REFLECTING))
    return {
        "info:id": ("uniform token", OPENPBR_SHADER),
        "inputs:base_color": ("color3f", columns["diffuse"]),
        "inputs:base_weight": ("float", 1.0),
        "inputs:base_diffuse_roughness": ("float", 0.0),
        "inputs:specular_weight": ("float", 1.0 if max(specular) > 0 else 0.0),
        "inputs:specular_color": ("color3f", _divide_by_largest(specular)),
        "inputs:specular_roughness": ("float", columns["roughness"][0]),
        "inputs:specular_ior": ("float", float(np.float32((1 + root) / (1 - root)))),
        "inputs:emission_luminance": ("float", max(emission)),
        "inputs:emission_color": ("color3f", _divide_by_largest(emission)),
    }


def _divide_by_largest(rgb: Sequence[float]) -> list[float]:
    """Return a color divided by its largest channel; white for black."""
    scaled = np.array(rgb) / max(rgb) if max(rgb) > 0 else np.ones(3)
    return [float(value) for value in scaled.astype(np.float32)]
