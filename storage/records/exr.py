"""Half-float RGB OpenEXR in memory: what a stored picture is.

The file itself says how it is packed, so a reader need not be told. Which codecs are used is
`storage.records.profiles`. Equal pictures give equal bytes: the header holds nothing of the clock.
"""

import contextlib
import io
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from storage.conventions import HALF_FLOAT_MAX
from storage.errors import TrilightError
from storage.settings.ranges import FLOAT32_MAX, Within

MAX_RESOLUTION = 8192
"""A larger window in a file from outside is refused before any memory is taken."""

_MAX_BYTES = 3 << 30
"""Maximum bytes of pixels: 64 lights of 2048 x 2048, the most that is ever written, take this much
at 4 bytes a value."""


INT32 = Within(-(2**31), 2**31 - 1)
FLOAT32 = Within(-FLOAT32_MAX, FLOAT32_MAX)
"""Ranges of the numbers in a header."""

_LOSSY = frozenset(
    getattr(OpenEXR, f"{name}_COMPRESSION") for name in ("B44", "B44A", "DWAA", "DWAB", "LJ2K")
)

MAGIC = b"\x76\x2f\x31\x01"
"""First bytes of a file."""
MANY_PARTS = 0x1000
"""Flag of a file of several parts, behind them."""
_MOST_ATTRIBUTES = 4096
_MOST_CHANNEL_BYTES = 1 << 18
_MOST_HEADER_BYTES = 16 << 20
"""Most of all headers of a file: the library compares each attribute with all others."""

_MOST_LISTED = 6
"""Maximum number of channel names in a message."""

HALF_FLOATS = np.arange(1 << 16, dtype=np.uint16).view(np.float16).astype(np.float32)
"""Every half float by its bits: looking them up takes half of the time of numpy's conversion."""
FIRST_ILLEGAL = 0x7C00
"""Bits of infinity: all below are the half floats that a picture may hold, in their order."""
_MINUS_INFINITY = 0xFC00

Stored = NDArray[np.uint16] | NDArray[np.float32]
"""A picture as a file holds it: bits of half floats, or the float32 of other tools."""


Attributes = Mapping[str, str | int | float]
"""Entries of a header beyond what every file has."""

Header = Mapping[str, Any]
"""The header of a file as the library gives it."""


def encode_exr(radiance_rgb: NDArray[np.float32], dwa_level: float | None = None) -> bytes:
    """Return the OpenEXR file of a picture, rounded to half floats; one thread.

    Args:
        radiance_rgb: [R, R, 3] linear radiance, finite, in [0, 65504].
        dwa_level: as `encode_channels`. A lossy file may hold values below 0, or infinite ones
            where the brightest rounds up: callers look at what comes back.

    Raises:
        TrilightError: a value is not finite, negative, or too large for a half float.
    """
    return encode_channels({"RGB": to_half(radiance_rgb)}, dwa_level=dwa_level)


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
    channels: Mapping[str, NDArray[np.float16] | NDArray[np.float32]],
    *,
    attributes: Attributes | None = None,
    dwa_level: float | None = None,
) -> bytes:
    """Return the OpenEXR file of named channels, [H, W] each or [H, W, 3] under the name RGB.

    Args:
        channels: the channels by name.
        attributes: entries of the header beyond what every file has.
        dwa_level: level of the lossy DWAB, greater is coarser; None for ZIP, which is exact on half
            floats and known to every reader.

    Raises:
        TrilightError: a number among the attributes that a header cannot hold: integers end at
            2^31 - 1, and floats with float32.
    """
    for name, value in (attributes or {}).items():
        within = INT32 if isinstance(value, int) else FLOAT32
        if not isinstance(value, str) and not within.holds(value):
            raise TrilightError(  # OpenEXR would wrap it around, or make it infinite
                f"picture: attribute {name} is {value!r}; expected a number {within}, or text."
            )
    packing = {"compression": OpenEXR.ZIP_COMPRESSION}
    if dwa_level is not None:
        # an int would be an attribute of another type
        packing = {"compression": OpenEXR.DWAB_COMPRESSION, "dwaCompressionLevel": float(dwa_level)}
    header = {"type": OpenEXR.scanlineimage, **packing, **(attributes or {})}
    stream = io.BytesIO()
    OpenEXR.File(header, dict(channels), num_threads=0).write(stream)
    return stream.getvalue()


def decode_exr(data: bytes) -> NDArray[np.float32]:
    """Return the picture of an OpenEXR file as float32 [H, W, 3]; raises as `decode_channels`.

    Where the file is packed with losses, what they took below 0 is 0 again.
    """
    return to_float32(decode_stored(data))


def to_float32(stored: Stored) -> NDArray[np.float32]:
    """Return the numbers of pictures that may be bits of half floats, of any shape."""
    if stored.dtype == np.float32:
        return np.asarray(stored, np.float32)
    return np.take(HALF_FLOATS, stored.view(np.uint16))


def decode_stored(data: bytes) -> Stored:
    """Return the picture [H, W, 3] of `decode_exr` as the file holds it.

    A function of half floats, such as their logarithm, can be looked up by these bits.

    Raises:
        TrilightError: as `decode_exr`.
    """
    header = read_header(data)
    pixels = decode_channels(data, "RGB", header)["RGB"]
    lossy = header["compression"] in _LOSSY
    if pixels.dtype != np.float16:  # other tools write float32
        return np.asarray(np.maximum(pixels, 0) if lossy else pixels, np.float32)
    bits: NDArray[np.uint16] = pixels.view(np.uint16)
    if lossy and bits.max(initial=0) <= _MINUS_INFINITY:  # what is not a number stays so
        np.maximum(bits.view(np.int16), 0, out=bits.view(np.int16))
    return bits


def decode_channels(
    data: bytes,
    names: Collection[str],
    header: Header | None = None,
    *,
    size: tuple[int, int] | None = None,
    what: str = "picture",
    separate: bool = False,
) -> dict[str, NDArray]:
    """Return the channels of an OpenEXR file by name, R, G and B as one unless `separate`.

    The library takes memory for all that a file's headers speak of, and small files can speak of
    much: no pixel is read before the headers are what is expected.

    Args:
        data: the file.
        names: of the channels that it must have.
        header: that of `read_header`, where it is known.
        size: height and width as they must be; None for any.
        what: the file in messages about its size.
        separate: keep R, G and B apart.

    Raises:
        TrilightError: not an EXR file, truncated, of several parts, with other channels, larger
            than MAX_RESOLUTION, of more than 3 GiB, or of another size.
    """
    with _readable():
        header = read_header(data) if header is None else header
        if size is not None and (stored_size := window_size(header)) != size:
            raise TrilightError(f"{what}: {list(stored_size)} pixels; expected {list(size)}.")
        _check_pixels(header, names)
        file = OpenEXR.File(io.BytesIO(data), num_threads=0, separate_channels=separate)
        pixels = {name: channel.pixels for name, channel in file.channels().items()}
    if size is not None and any(channel.shape[:2] != size for channel in pixels.values()):
        raise TrilightError(f"{what}: a channel has other pixels than {list(size)}; expected none.")
    return pixels


def read_header(data: bytes) -> Header:
    """Return the header of an OpenEXR file of one part; reads no pixel.

    Raises:
        TrilightError: not an EXR file, truncated, or of several parts.
    """
    with _readable():
        find_header_end(data)
        parts = OpenEXR.File(io.BytesIO(data), header_only=True, num_threads=0).parts
    if len(parts) != 1:
        raise TrilightError(f"picture: the file has {len(parts)} parts; expected one.")
    return parts[0].header


def find_header_end(data: bytes) -> int:
    """Return where the headers of an OpenEXR file end, found without the library.

    Raises:
        TrilightError: they have more attributes, channels or bytes than are read.
    """
    is_many = int.from_bytes(data[4:8], "little") & MANY_PARTS
    at = 8
    attributes = 0
    channel_bytes = 0
    while data.startswith(MAGIC):
        while data[at : at + 1] not in (b"", b"\0"):  # name, type, size, value
            kind = data.find(0, at) + 1
            value = ((data.find(0, kind) + 1 if kind else 0) or len(data)) + 4
            size = int.from_bytes(data[value - 4 : value], "little")
            attributes += 1
            channel_bytes += size if data[kind : value - 5] == b"chlist" else 0
            at = value + size
            if (
                attributes > _MOST_ATTRIBUTES
                or channel_bytes > _MOST_CHANNEL_BYTES
                or at > _MOST_HEADER_BYTES
            ):
                raise TrilightError(
                    f"picture: its header has {attributes} attributes or more, {channel_bytes} "
                    f"bytes of channels, {at} bytes; expected at most {_MOST_ATTRIBUTES}, "
                    f"{_MOST_CHANNEL_BYTES} and {_MOST_HEADER_BYTES}. Write it again without them."
                )
        at += 1
        if not is_many or data[at : at + 1] in (b"", b"\0"):
            break
    return at + bool(is_many)


@contextlib.contextmanager
def _readable() -> Iterator[None]:
    """Turn what the library raises of damaged files into one sentence."""
    try:
        yield
    except (RuntimeError, ValueError, KeyError) as error:
        if isinstance(error, TrilightError):
            raise
        raise TrilightError("picture: not a readable OpenEXR file.") from error


def window_size(header: Header) -> tuple[int, int]:
    """Return height and width of the data window of a header."""
    (x_min, y_min), (x_max, y_max) = np.asarray(header["dataWindow"]).tolist()
    return y_max - y_min + 1, x_max - x_min + 1


def _check_pixels(header: Header, names: Collection[str]) -> None:
    """Refuse pixels that are not expected, or that take too much memory."""
    stored = sorted(channel.name for channel in header["channels"])
    expected = sorted(names)
    if stored != expected:
        raise TrilightError(
            f"picture: channels are {_list_names(stored)}; expected {_list_names(expected)}."
        )
    if header["type"] not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
        raise TrilightError(f"picture: its storage is {header['type']}; expected lines or tiles.")
    size = window_size(header)
    if max(size) > MAX_RESOLUTION:
        raise TrilightError(
            f"picture: the data window spans {list(size)} pixels; expected at most "
            f"{MAX_RESOLUTION} each way."
        )
    most_bytes = 4 * len(stored) * math.prod(size)
    if most_bytes > _MAX_BYTES:
        raise TrilightError(
            f"picture: {len(stored)} channels of {list(size)} pixels may take {most_bytes} bytes; "
            f"expected at most {_MAX_BYTES}."
        )


def _list_names(names: Sequence[str]) -> str:
    if len(names) <= _MOST_LISTED:
        return ", ".join(names) or "none"
    return f"{', '.join(names[:_MOST_LISTED])} and {len(names) - _MOST_LISTED} more"


def encode_layers(
    layers_rgb: Mapping[str, NDArray[np.float32]], attributes: Attributes | None = None
) -> bytes:
    """Return the OpenEXR file of pictures [R, R, 3] by names of layers; raises as `encode_exr`.

    The channels of a layer are `<layer>.R`, `.G` and `.B`, those of the layer "" have no prefix.
    """
    pictures = to_half(np.stack(list(layers_rgb.values())))
    planes = np.moveaxis(pictures, -1, 1).reshape(-1, *pictures.shape[1:3])
    channels = dict(zip(_channels_of(layers_rgb), np.ascontiguousarray(planes), strict=True))
    return encode_channels(channels, attributes=attributes)


def decode_layers(
    data: bytes, names: Sequence[str], size: tuple[int, int] | None = None, what: str = "picture"
) -> NDArray[np.float32]:
    """Return the pictures of an OpenEXR file, float32 [N, H, W, 3]; arguments as `decode_channels`.

    `names` are those of all of its layers.
    """
    channels = _channels_of(names)
    by_channel = decode_channels(data, channels, size=size, what=what, separate=True)
    planes = np.stack([np.asarray(by_channel[name], np.float32) for name in channels])
    return np.moveaxis(planes.reshape(len(names), 3, *planes.shape[1:]), 1, -1).copy()


def _channels_of(layers: Iterable[str]) -> list[str]:
    return [f"{layer}.{channel}".strip(".") for layer in layers for channel in "RGB"]
