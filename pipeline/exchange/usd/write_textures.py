"""Writes the textures of a material as UsdUVTexture shaders, and the connections of its prims.

A textured column of a material is an input of its UsdPreviewSurface that is connected to a texture,
which reads the coordinates `st` of the meshes. Coordinates need no conversion: v is up, and the
bottom row of a picture is at v = 0. A textured material has no OpenPBR shader, so that MaterialX
renderers use the preview with its textures instead of one color. A specular texture is also
connected to the roughness of an absent coat: Blender drops specular textures, but keeps this one.

The file of a texture is lossless: PNG for 8 bits, OpenEXR for float32, with one channel or three.
Picture files begin with the top row, textures of a scene with the bottom row. Equal textures share
a file.
"""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.usd.authoring import Attributes
from pipeline.exchange.usd.prim_names import MAP_TEXTS, TEXTURE_ROW, format_map, texture_attribute
from storage.errors import TrilightError
from storage.records.exr import MAX_RESOLUTION, decode_channels, encode_channels
from storage.records.scene import Scene
from storage.records.texture import CONSTANT, NORMAL, TEXTURED, MapSource, Texture

PREVIEW = "Preview"
OPENPBR = "OpenPBR"
"""Names of the two shaders of a material."""

SHADERS = {
    "diffuse": "DiffuseTexture",
    "specular": "SpecularTexture",
    "roughness": "RoughnessTexture",
    NORMAL: "NormalTexture",
}
"""Name of the texture shader of each column, and of the normal map."""

COORDINATES = "Coordinates"
"""Name of the shader that reads texture coordinates."""

ST = "primvars:st"
"""Attribute of the meshes of a textured scene."""

_INPUTS = {
    "diffuse": ("color3f", "inputs:diffuseColor", "outputs:rgb", "float3"),
    "specular": ("color3f", "inputs:specularColor", "outputs:rgb", "float3"),
    "roughness": ("float", "inputs:roughness", "outputs:r", "float"),
    NORMAL: ("normal3f", "inputs:normal", "outputs:rgb", "float3"),
}
"""Type and name of the input, and name and type of its output, by column."""

_TO_VECTORS: Attributes = {
    "inputs:scale": ("float4", (2.0, 2.0, 2.0, 1.0)),
    "inputs:bias": ("float4", (-1.0, -1.0, -1.0, 0.0)),
    "inputs:fallback": ("float4", (0.0, 0.0, 1.0, 1.0)),
}
"""Inputs that make vectors of the texels of a normal map."""

COAT_ROUGHNESS = "inputs:clearcoatRoughness"
"""Input of a preview without a coat; it preserves the specular texture in Blender."""

Used = Mapping[str, tuple[int, Texture]]
"""Row and texture of each textured column of a material, and of its normal map."""

Links = Mapping[str, tuple[str, str | None]]
"""Type and connected output, if any, of each input and output by name."""


def used_textures(scene: Scene, row: int) -> Used:
    """Return the textures of a material row."""
    if scene.material_textures is None:
        return {}
    normal = CONSTANT if scene.normal_textures is None else int(scene.normal_textures[row])
    index = [*scene.material_textures[row].tolist(), normal]
    return {
        name: (texture, scene.textures[texture])
        for name, texture in zip((*TEXTURED, NORMAL), index, strict=True)
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
    tables: dict[str, Attributes] = {
        f"/{SHADERS[name]}": _texture_table(row, texture) for name, (row, texture) in used.items()
    }
    if NORMAL in used:
        path = f"/{SHADERS[NORMAL]}"
        tables[path] = {**tables[path], **_TO_VECTORS}
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


_CHANNELS = {1: "Y", 3: "RGB"}
"""OpenEXR channel names by channel count: a number or a color."""


def texture_file(texture: Texture) -> str:
    """Return the file name of a texture."""
    suffix = "png" if texture.texels.dtype == np.uint8 else "exr"
    return f"texture-{texture.sha256[:16]}.{suffix}"


def encode_texture(texture: Texture) -> bytes:
    """Return the bytes of a texture's file; they contain no time stamp.

    Raises:
        TrilightError: the texture is larger than the USD reader accepts.
    """
    from PIL import Image

    height, width, channels = texture.texels.shape
    if max(height, width) > MAX_RESOLUTION:
        raise TrilightError(
            f"texture: {width} x {height} texels; expected at most {MAX_RESOLUTION} each way in "
            "USD. Write it as .safetensors, or make it smaller."
        )
    picture = np.ascontiguousarray(texture.texels[::-1])
    if picture.dtype == np.float32:
        values = picture if channels == 3 else picture[..., 0]
        return encode_channels({_CHANNELS[channels]: np.ascontiguousarray(values)})
    stream = io.BytesIO()
    Image.fromarray(picture if channels == 3 else picture[..., 0]).save(stream, "PNG")
    return stream.getvalue()


def decode_texture(data: bytes, *, is_exr: bool, is_srgb: bool, source: MapSource) -> Texture:
    """Decode a file of `encode_texture`.

    Raises:
        LookupError: `encode_texture` did not write the file.
    """
    try:
        texels: NDArray[Any] = _exr_texels(data) if is_exr else _png_texels(data)
        texture = Texture(texels=np.ascontiguousarray(texels), is_srgb=is_srgb, source=source)
        texture.check("texture")
    except (TrilightError, OSError, SyntaxError, ValueError) as error:
        raise LookupError("it is no texture that was written here") from error
    return texture


def _exr_texels(data: bytes) -> NDArray[np.float32]:
    from storage.records.exr import channel_names

    name = "Y" if channel_names(data) == ["Y"] else "RGB"
    pixels = decode_channels(data, name, lambda header: None)[name]
    texels: NDArray[np.float32] = pixels.reshape(*pixels.shape[:2], -1)[::-1]
    return texels


def _png_texels(data: bytes) -> NDArray[np.uint8]:
    from PIL import Image

    with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
        if max(image.size) > MAX_RESOLUTION or image.mode not in ("L", "RGB"):
            raise ValueError(f"{image.size} in mode {image.mode}")
        pixels: NDArray[np.uint8] = np.asarray(image, np.uint8)
    return pixels.reshape(*pixels.shape[:2], -1)[::-1]
