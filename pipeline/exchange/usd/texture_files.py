"""Writes and reads a texture as a lossless file beside a stage.

8-bit textures become PNG, float32 ones OpenEXR, with one channel or three. Picture files begin with
the top row, textures of a scene with the bottom row. Equal textures share a file.
"""

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError
from storage.records.exr import MAX_RESOLUTION, decode_channels, encode_channels
from storage.records.texture import MapSource, Texture

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
