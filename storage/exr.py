"""Half-float RGB OpenEXR in memory: what a stored picture is.

ZIP is lossless on the half floats and every reader knows it; which codec is the best trade is
measured with the shards. Equal pictures give equal bytes: the header holds nothing of the clock.
"""

import io
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from storage.conventions import HALF_FLOAT_MAX
from storage.errors import TrilightError

MAX_RESOLUTION = 8192
"""A larger window in a file from outside is refused before any memory is taken."""


Attributes = Mapping[str, str | int | float]
"""Entries of a header beyond what every file has."""

Header = Mapping[str, Any]
"""The header of a file as the library gives it."""


def encode_exr(radiance_rgb: NDArray[np.float32], attributes: Attributes | None = None) -> bytes:
    """Return the OpenEXR file of a picture, rounded to half floats.

    Args:
        radiance_rgb: [R, R, 3] linear radiance, finite, in [0, 65504].
        attributes: more entries of the header, by name.

    Raises:
        TrilightError: a value is not finite, negative, or too large for a half float.
    """
    return encode_channels({"RGB": to_half(radiance_rgb)}, attributes)


def to_half(radiance_rgb: NDArray[np.float32]) -> NDArray[np.float16]:
    """Return radiance as a picture stores it; raises TrilightError as `encode_exr`."""
    legal = np.isfinite(radiance_rgb) & (radiance_rgb >= 0) & (radiance_rgb <= HALF_FLOAT_MAX)
    if not legal.all():
        index = tuple(int(i) for i in np.argwhere(~legal)[0])
        raise TrilightError(
            f"picture: radiance{list(index)} is {radiance_rgb[index]}; expected a finite value in "
            f"[0, {HALF_FLOAT_MAX:.0f}]."
        )
    return np.ascontiguousarray(radiance_rgb, np.float16)


def encode_channels(
    channels: Mapping[str, NDArray[np.float16]], attributes: Attributes | None = None
) -> bytes:
    """Return the OpenEXR file of named channels, [H, W] each or [H, W, 3] under the name RGB."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    stream = io.BytesIO()
    OpenEXR.File({**header, **(attributes or {})}, dict(channels), num_threads=0).write(stream)
    return stream.getvalue()


def decode_exr(data: bytes) -> NDArray[np.float32]:
    """Return the picture of an OpenEXR file as float32 [H, W, 3].

    Raises:
        TrilightError: not an EXR file, truncated, larger than MAX_RESOLUTION, or without RGB.
    """
    channels = decode_channels(data, _check_window)
    if "RGB" not in channels:
        raise TrilightError(f"picture: channels are {sorted(channels)}; expected R, G and B.")
    return np.asarray(channels["RGB"], np.float32)


def decode_channels(
    data: bytes, check: Callable[[Header], None], *, separate: bool = False
) -> dict[str, NDArray]:
    """Return the channels of an OpenEXR file by name, R, G and B as one unless `separate`.

    Args:
        data: the file.
        check: called with the header before any pixel is read; raises TrilightError.
        separate: keep R, G and B apart.

    Raises:
        TrilightError: not an EXR file, truncated, or refused by `check`.
    """
    try:
        check(OpenEXR.File(io.BytesIO(data), header_only=True, num_threads=0).header())
        file = OpenEXR.File(io.BytesIO(data), num_threads=0, separate_channels=separate)
        return {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, KeyError) as error:
        if isinstance(error, TrilightError):
            raise
        raise TrilightError(f"picture: not a readable OpenEXR file ({error}).") from error


def window_size(header: Header) -> tuple[int, int]:
    """Return height and width of the data window of a header."""
    (left, top), (right, bottom) = np.asarray(header["dataWindow"]).tolist()
    return bottom - top + 1, right - left + 1


def _check_window(header: Header) -> None:
    size = window_size(header)
    if max(size) > MAX_RESOLUTION:
        raise TrilightError(
            f"picture: the data window spans {list(size)} pixels; expected at most "
            f"{MAX_RESOLUTION} each way."
        )
