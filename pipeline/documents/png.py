"""Encodes pictures as PNG files, for display, never for measurement."""

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image


def encode_png(pixels: NDArray[np.uint8]) -> bytes:
    """Return the PNG file of a picture, [H, W] grey, [H, W, 3] RGB or [H, W, 4] RGBA."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG")
    return stream.getvalue()
