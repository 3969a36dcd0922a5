"""Half-float RGB OpenEXR in memory: what a stored picture is.

ZIP is lossless on the half floats and every reader knows it; which codec is the best trade is
measured with the shards. Equal pictures give equal bytes: the header holds nothing of the clock.
"""

import io

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from storage.conventions import HALF_FLOAT_MAX
from storage.errors import TrilightError

MAX_RESOLUTION = 8192
"""A larger window in a file from outside is refused before any memory is taken."""


def encode_exr(radiance_rgb: NDArray[np.float32]) -> bytes:
    """Return the OpenEXR file of a picture, rounded to half floats.

    Args:
        radiance_rgb: [R, R, 3] linear radiance, finite, in [0, 65504].

    Raises:
        TrilightError: a value is not finite, negative, or too large for a half float.
    """
    legal = np.isfinite(radiance_rgb) & (radiance_rgb >= 0) & (radiance_rgb <= HALF_FLOAT_MAX)
    if not legal.all():
        index = tuple(int(i) for i in np.argwhere(~legal)[0])
        raise TrilightError(
            f"picture: radiance{list(index)} is {radiance_rgb[index]}; expected a finite value in "
            f"[0, {HALF_FLOAT_MAX:.0f}]."
        )
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    stream = io.BytesIO()
    half = np.ascontiguousarray(radiance_rgb, np.float16)
    OpenEXR.File(header, {"RGB": half}, num_threads=0).write(stream)
    return stream.getvalue()


def decode_exr(data: bytes) -> NDArray[np.float32]:
    """Return the picture of an OpenEXR file as float32 [H, W, 3].

    Raises:
        TrilightError: not an EXR file, truncated, larger than MAX_RESOLUTION, or without RGB.
    """
    try:
        header = OpenEXR.File(io.BytesIO(data), header_only=True, num_threads=0).header()
        low, high = np.asarray(header["dataWindow"])
        if (high - low + 1 > MAX_RESOLUTION).any():
            raise TrilightError(
                f"picture: the data window spans {list(high - low + 1)} pixels; expected at most "
                f"{MAX_RESOLUTION} each way."
            )
        channels = OpenEXR.File(io.BytesIO(data), num_threads=0).channels()
    except (RuntimeError, ValueError, KeyError) as error:
        if isinstance(error, TrilightError):
            raise
        raise TrilightError(f"picture: not a readable OpenEXR file ({error}).") from error
    if "RGB" not in channels:
        raise TrilightError(f"picture: channels are {sorted(channels)}; expected R, G and B.")
    return np.asarray(channels["RGB"].pixels, np.float32)
