"""Picture files as values in [0, 1], as they are encoded; only children come here."""

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from storage.errors import Rejected
from storage.records.texture import MAX_SIDE

MAX_PIXELS = 1 << 26
"""Most pixels of a picture: 8192 x 8192."""

_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "TGA")
_MOST = {"I;16": 65535, "I;16L": 65535, "I;16B": 65535, "I": 65535}


def picture_values(data: bytes) -> NDArray[np.float32]:
    """Return a picture [H, W, 1 or 3], the top row first; alpha is left out.

    Raises:
        Rejected: load_error, too_many_pixels.
    """
    try:
        with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
            if image.width * image.height > MAX_PIXELS or max(image.size) > MAX_SIDE:
                raise Rejected(
                    "too_many_pixels",
                    f"{image.width} x {image.height}; expected at most {MAX_PIXELS} in all and "
                    f"{MAX_SIDE} a side: scale it down",
                )
            if image.mode in _MOST:
                values = np.asarray(image, np.float32) / np.float32(_MOST[image.mode])
            elif image.mode == "F":
                raise Rejected("load_error", "it has floats; expected 8 or 16 bits a value")
            else:
                mode = "L" if image.mode in ("1", "L", "LA") else "RGB"
                values = np.asarray(image.convert(mode), np.float32) / np.float32(255)
    except (OSError, SyntaxError, ValueError, LookupError, Image.DecompressionBombError) as error:
        raise Rejected("load_error", f"it is not a readable picture ({error})") from error
    return values if values.ndim == 3 else values[..., None]
