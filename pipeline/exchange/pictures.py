"""Decodes untrusted pictures to arrays; few formats, and sizes checked before any allocation.

8-bit values stay 8-bit values, so that textures hold exactly what their files hold.
"""

import io

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.light_pictures import read_linear_picture
from storage.conventions import linear_from_srgb8
from storage.errors import Rejected, TrilightError

MAX_BYTES = 256 << 20
MAX_PIXELS = 64 << 20
"""Maximum size of one picture."""

Pixels = NDArray[np.uint8] | NDArray[np.float32]
"""[H, W, C] encoded as the file has them, the top row first; uint8 and C of 1 to 4, or float32."""


def decode_pixels(
    data: bytes, name: str, lost: list[str] | None = None, *, is_color: bool = True
) -> Pixels | None:
    """Decode a picture; return None where the bytes are not one.

    16-bit pictures become float32 from 0 to 1; OpenEXR and Radiance are linear float32.

    Args:
        data: the file.
        name: name for messages.
        lost: receives a sentence for each unsupported feature.
        is_color: True where the values are colors, so that primaries apply.

    Raises:
        TrilightError: the picture has more pixels than MAX_PIXELS.
    """
    try:
        picture = read_linear_picture(data, MAX_PIXELS, is_color=is_color)
    except Rejected as error:
        if error.reason == "too_many_pixels":
            raise TrilightError(f"{name}: {error.message}.") from error
        if lost is not None:
            lost.append(f"{name!r:.100}: {error.message}")
        return None
    if picture is None:
        return _decode_with_pillow(data, name)
    if lost is not None:
        lost += [f"{name!r:.100}: {sentence}" for sentence in picture.unread]
    return picture.values


def linear_rgb(pixels: Pixels) -> NDArray[np.float32]:
    """Return the linear colors [H, W, 3] of a picture without alpha; 8 bits are sRGB."""
    rgb = pixels[..., :3] if pixels.shape[2] >= 3 else np.repeat(pixels[..., :1], 3, axis=2)
    if rgb.dtype == np.uint8:
        decoded: NDArray[np.float32] = linear_from_srgb8()[rgb]
        return decoded
    return np.asarray(rgb, np.float32)


def is_encoded(pixels: Pixels) -> bool:
    """Return whether pixels of an unstated color space count as sRGB: colors in 8 bits."""
    return bool(pixels.dtype == np.uint8 and pixels.shape[2] >= 3)


def _decode_with_pillow(data: bytes, name: str) -> Pixels | None:
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "TIFF", "BMP", "TGA")) as image:
            _require_size(image.width, image.height, name)
            if image.mode.startswith("I;16") or image.mode == "I":
                return (np.asarray(image, np.float32) / np.float32(65535))[..., None]
            if image.mode == "F":
                return np.asarray(image, np.float32)[..., None]
            mode = image.mode if image.mode in ("L", "RGB", "RGBA") else "RGB"
            values: NDArray[np.uint8] = np.asarray(image.convert(mode), np.uint8)
    except TrilightError:
        raise
    except Image.DecompressionBombError as error:
        raise TrilightError(f"{name}: expected at most {MAX_PIXELS} pixels.") from error
    except (OSError, SyntaxError, ValueError, LookupError):
        return None  # errors that Pillow raises for a damaged file
    return values if values.ndim == 3 else values[..., None]


def _require_size(width: int, height: int, name: str) -> None:
    if width * height > MAX_PIXELS:
        raise TrilightError(
            f"{name}: {width} x {height} pixels; expected at most {MAX_PIXELS} pixels."
        )
