"""Decodes picture files to values in [0, 1]; runs in child processes only."""

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from pipeline.foreign.light_pictures import read_linear_picture
from pipeline.foreign.linear_picture import clip_to_unit
from pipeline.foreign.picture import UNREADABLE_PICTURE
from storage.errors import Rejected
from storage.records.texture import MAX_SIDE

MAX_PIXELS = 1 << 26
"""Most pixels of a picture: 8192 x 8192."""

_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "TGA", "WEBP")
_MOST = {"I;16": 65535, "I;16L": 65535, "I;16B": 65535, "I": 65535}


def picture_values(data: bytes, *, is_color: bool) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """Return a picture [H, W, 1 or 3], the top row first, and notes on unread parts.

    Alpha is left out. Floats are linear; float colors are encoded to sRGB here.

    Raises:
        Rejected: load_error, not_hdr, not_a_number, too_many_pixels.
    """
    linear = read_linear_picture(data, MAX_PIXELS, is_color=is_color)
    if linear is None:
        values, is_linear = _plain_values(data)
        unread: tuple[str, ...] = ()
    else:
        values = linear.values[..., : 3 if linear.values.shape[2] >= 3 else 1]
        is_linear = True
        unread = linear.unread
        if max(values.shape) > MAX_SIDE:
            raise _too_large(values.shape[1], values.shape[0])
    values, cut = clip_to_unit(values)
    return (_encode(values) if is_linear and is_color else values), (*unread, *cut)


def are_normals(values: NDArray[np.float32]) -> bool:
    """Return whether nearly all values [H, W, 3] code unit vectors, most of them along +Z."""
    vectors = 2 * values - 1
    is_unit = np.abs(np.linalg.norm(vectors, axis=2) - 1) < 0.05
    return values.shape[2] == 3 and bool((is_unit & (vectors[..., 2] > 0)).mean() > 0.98)


def _encode(linear: NDArray[np.float32]) -> NDArray[np.float32]:
    encoded = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
    return encoded.astype(np.float32)


def _too_large(width: int, height: int) -> Rejected:
    return Rejected(
        "too_many_pixels",
        f"{width} x {height}; expected at most {MAX_PIXELS} in all and {MAX_SIDE} a side: scale it "
        "down",
    )


def _plain_values(data: bytes) -> tuple[NDArray[np.float32], bool]:
    """Return a picture of another format, and True where its values are linear floats."""
    is_linear = False
    try:
        with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
            if image.width * image.height > MAX_PIXELS or max(image.size) > MAX_SIDE:
                raise _too_large(image.width, image.height)
            if image.mode in _MOST:
                values = np.asarray(image, np.float32) / np.float32(_MOST[image.mode])
            elif image.mode == "F":
                values = np.asarray(image, np.float32)
                is_linear = True
            else:
                mode = "L" if image.mode in ("1", "L", "LA") else "RGB"
                values = np.asarray(image.convert(mode), np.float32) / np.float32(255)
    except UnidentifiedImageError as error:
        raise Rejected(
            "load_error",
            "it is cut off, or no PNG, JPEG, TIFF, BMP, TGA or WebP picture that is read; of TIFF, "
            "colors of 16 or 32 bits are not: write it as PNG or OpenEXR",
        ) from error
    except (OSError, SyntaxError, ValueError, LookupError, Image.DecompressionBombError) as error:
        raise Rejected("load_error", UNREADABLE_PICTURE) from error
    return (values if values.ndim == 3 else values[..., None]), is_linear
