"""Pictures of strangers as arrays: decoded by name of few formats, and bounded before any memory.

Bytes stay bytes, so that what is read is what is stored.
"""

import io

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError
from storage.records.exr import channel_names, decode_channels, window_size

MAX_BYTES = 256 << 20
MAX_PIXELS = 64 << 20
"""Maximum size of one picture."""

Pixels = NDArray[np.uint8] | NDArray[np.float32]
"""[H, W, C] encoded as the file has them, the top row first; uint8 and C of 1 to 4, or float32."""

_EXR_MAGIC = b"\x76\x2f\x31\x01"
_CHANNELS = {("Y",): "Y", ("B", "G", "R"): "RGB", ("A", "B", "G", "R"): "RGBA"}


def decoded_pixels(data: bytes, name: str) -> Pixels | None:
    """Return a picture, or None where the bytes are none.

    16-bit pictures become float32 from 0 to 1, OpenEXR is float32 as it is.

    Raises:
        TrilightError: it has more pixels than MAX_PIXELS; `name` stands for it.
    """
    return _exr(data, name) if data.startswith(_EXR_MAGIC) else _plain(data, name)


def is_encoded(pixels: Pixels) -> bool:
    """Return whether pixels of an unstated colour space are taken as sRGB: colours in 8 bits."""
    return bool(pixels.dtype == np.uint8 and pixels.shape[2] >= 3)


def _plain(data: bytes, name: str) -> Pixels | None:
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "TIFF", "BMP", "TGA")) as image:
            _require_size(image.width, image.height, name)
            if image.mode.startswith("I;16") or image.mode == "I":
                return (np.asarray(image, np.float32) / np.float32(65535))[..., None]
            mode = image.mode if image.mode in ("L", "RGB", "RGBA") else "RGB"
            values: NDArray[np.uint8] = np.asarray(image.convert(mode), np.uint8)
    except TrilightError:
        raise
    except Image.DecompressionBombError as error:
        raise TrilightError(f"{name}: expected at most {MAX_PIXELS} pixels.") from error
    except (OSError, SyntaxError, ValueError, LookupError):
        return None  # PIL says so in all of these ways
    return values if values.ndim == 3 else values[..., None]


def _exr(data: bytes, name: str) -> Pixels | None:
    def check(header: object) -> None:
        height, width = window_size(header)  # type: ignore[arg-type]
        _require_size(width, height, name)

    try:
        key = _CHANNELS.get(tuple(sorted(channel_names(data))))
        if key is None:
            return None
        separate = tuple("RGBA" if key == "RGBA" else key)
        found = decode_channels(data, separate, check, separate=True)
    except TrilightError as error:
        if name in str(error):
            raise
        return None
    return np.stack([found[letter].astype(np.float32) for letter in separate], axis=-1)


def _require_size(width: int, height: int, name: str) -> None:
    if width * height > MAX_PIXELS:
        raise TrilightError(
            f"{name}: {width} x {height} pixels; expected at most {MAX_PIXELS} pixels."
        )
