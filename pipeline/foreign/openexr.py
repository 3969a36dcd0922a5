"""Reader of untrusted OpenEXR files: the picture of a file, in linear Rec.709.

- The display window is the picture: pixels outside are cropped, and missing pixels are black.
  An environment map (attribute `envmap`) fills its data window, as its definition demands.
- The colors are R, G and B, or luminance and chroma, or a single channel: of the whole file, or
  of its one layer or part that has some. Notes name all other channels.
- Chromaticities, or the id of a color space, define the primaries.
"""

import io
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from pipeline.foreign.linear_picture import (
    REC709,
    LinearPicture,
    as_rec709,
    luminance_weights,
    require_pixels,
)
from storage.errors import Rejected, TrilightError
from storage.records.exr import MANY_PARTS, find_header_end

_MAX_BYTES = 3 << 30
"""Maximum bytes of the pixels of all parts, since the library reads them all."""

_TILED = 0x200

_GREY = ("Y",)
_CHROMA = ("BY", "RY", "Y")
_COLOR = ("R", "G", "B")
_LETTERS = {"RED": "R", "GREEN": "G", "BLUE": "B", "ALPHA": "A"}
_MAIN_LAYERS = ("combined", "beauty", "rgba", "rgb", "color", "colour", "c")
"""Last words in the names of layers that hold the picture itself."""

_SPACES = {"acescg": "lin_ap1_scene", "lin_ap1": "lin_ap1_scene"} | {
    "aces2065-1": "lin_ap0_scene",
    "lin_ap0": "lin_ap0_scene",
}
_LINEAR = ("", "unknown", "data", "linear", "scene_linear", "lin_srgb", "lin_rec709", "raw")
"""Names of linear color spaces in OpenImageIO, in lower case, and ids of OpenEXR."""

_USED = frozenset(
    "channels compression dataWindow displayWindow lineOrder tiles type name view multiView "
    "chunkCount version envmap chromaticities colorInteropID acesImageContainerFlag "
    "oiio:ColorSpace".split()
)
_SAYS_NOTHING = frozenset(
    "screenWindowCenter screenWindowWidth preview owner comments capDate utcOffset longitude "
    "latitude altitude focus expTime aperture isoSpeed keyCode timeCode framesPerSecond xDensity "
    "wrapmodes software Software worldToCamera worldToNDC dwaCompressionLevel DateTime".split()
)
"""Attributes that do not affect the values of pixels."""


@dataclass(frozen=True)
class _Choice:
    """The channels of a part that are the picture."""

    part: int
    letters: tuple[str, ...]
    """R, G and B; Y; or BY, RY and Y; A may follow."""
    names: tuple[str, ...]
    """Names of the channels in the file, one for each letter."""
    layer: str
    """Layer of the channels, else their view, else ""; the first view counts as none."""


def read_openexr(data: bytes, max_pixels: int, *, is_color: bool) -> LinearPicture:
    """Return the picture of an OpenEXR file; arguments as for `read_linear_picture`.

    Raises:
        Rejected: load_error or too_many_pixels.
    """
    try:
        end = find_header_end(data)
    except TrilightError as error:
        raise Rejected("load_error", str(error)) from error
    headers = _read_headers(data)
    _require_whole(data, end)
    choice = _choose_channels(headers)
    header = headers[choice.part]
    window = _picture_window(header)
    _require_size(headers, window, max_pixels)
    values = _crop_to_window(_read_channels(data, headers, choice), header, window)
    primaries = _read_primaries(header)
    if set(_CHROMA) <= set(choice.letters):
        values = _from_chroma(values, primaries)
    if is_color and values.shape[-1] >= 3:
        values[..., :3] = as_rec709(values[..., :3], primaries)
    return LinearPicture(values=values, unread=tuple(_list_unread(headers, choice)))


def _read_headers(data: bytes) -> list[Mapping[str, Any]]:
    headers = [part.header for part in _read_parts(data, header_only=True)]
    for header in headers:
        if header.get("type") in (OpenEXR.deepscanline, OpenEXR.deeptile):
            raise Rejected("load_error", "it is deep (many samples a pixel); flatten it")
    if not headers:
        raise _cut_off_error()
    return headers


def _read_parts(data: bytes, *, header_only: bool) -> Sequence[Any]:
    try:
        file = OpenEXR.File(
            io.BytesIO(data), separate_channels=True, header_only=header_only, num_threads=0
        )
    except Exception as error:  # the library fails in many ways
        raise _cut_off_error() from error
    parts: Sequence[Any] = file.parts
    return parts


def _require_whole(data: bytes, at: int) -> None:
    """Raise Rejected where chunks of a file of one part are missing or lie beyond its end.

    The library would print many lines about such a file. The headers end at `at`.
    """
    flags = int.from_bytes(data[4:8], "little")
    first = len(data)
    last = 0
    if flags & MANY_PARTS:
        return
    while at < first:  # the table ends where the first chunk begins
        offset = int.from_bytes(data[at : at + 8], "little")
        at += 8
        first = min(first, offset)
        last = max(last, offset)
    head = 20 if flags & _TILED else 8  # ends in the size of what follows
    size = int.from_bytes(data[last + head - 4 : last + head], "little")
    if first < at or last + head + size > len(data):
        raise _cut_off_error()


def _cut_off_error() -> Rejected:
    return Rejected("load_error", "it is cut off or damaged; write it again")


def _choose_channels(headers: Sequence[Mapping[str, Any]]) -> _Choice:
    """Return the channels of the picture, those without a layer or further view first."""
    choices = list(_list_choices(headers))
    if bare := [choice for choice in choices if not choice.layer]:
        return bare[0]
    main = [
        choice
        for choice in choices
        if choice.layer.rpartition(".")[2].lower() in _MAIN_LAYERS
        or choice.layer == (headers[choice.part].get("multiView") or [""])[0]
    ]
    colors = [choice for choice in choices if choice.letters[0] != "Y"]
    for among in (main, colors, choices):
        if len(among) == 1:
            return among[0]
    layers = _list_names(choice.layer for choice in choices)
    names = [str(channel.name) for header in headers for channel in header["channels"]]
    raise Rejected(
        "load_error",
        f"its layers {layers} are pictures each; write one of them alone"
        if choices
        else f"its channels are {', '.join(names):.80}; expected R, G and B, or Y",
    )


def _list_choices(headers: Sequence[Mapping[str, Any]]) -> Iterator[_Choice]:
    """Yield all candidates for the picture, colors before grays."""
    layers: dict[tuple[int, str], dict[str, str]] = defaultdict(dict)
    first_view = next((header["view"] for header in headers if "view" in header), "")
    for part, header in enumerate(headers):
        for channel in header["channels"]:
            layer, _, letter = str(channel.name).rpartition(".")
            letter = _LETTERS.get(letter.upper(), letter.upper())
            layers[part, layer][letter] = str(channel.name)
    for color_letters in (_COLOR, _CHROMA, _GREY, None):
        for (part, layer), names in layers.items():
            letters = color_letters or tuple(set(names) - {"A"})  # one channel of any name is gray
            is_depth = letters == ("Z",) or layer.lower().endswith(("depth", "mist"))
            if is_depth or (letters == _GREY and "X" in names):
                continue  # or CIE XYZ
            if set(letters) <= set(names) and len(letters) == len(color_letters or _GREY):
                alpha = ("A",) if "A" in names else ()
                channel_names = tuple(names[letter] for letter in (*letters, *alpha))
                shown_letters = (*(color_letters or _GREY), *alpha)
                view = headers[part].get("view", first_view)
                bare = "" if view == first_view else view
                yield _Choice(part, shown_letters, channel_names, layer or bare)


def _box(header: Mapping[str, Any], name: str) -> tuple[int, int, int, int]:
    """Return left, top, width and height of a window."""
    (x_min, y_min), (x_max, y_max) = np.asarray(header[name]).tolist()
    return x_min, y_min, x_max - x_min + 1, y_max - y_min + 1


def _picture_window(header: Mapping[str, Any]) -> tuple[int, int, int, int]:
    if header.get("envmap") == OpenEXR.ENVMAP_CUBE:
        raise Rejected("load_error", "it is a cube map; convert it to latitude-longitude")
    return _box(header, "dataWindow" if "envmap" in header else "displayWindow")


def _require_size(
    headers: Sequence[Mapping[str, Any]], window: tuple[int, int, int, int], max_pixels: int
) -> None:
    require_pixels(*window[2:], max_pixels)
    stored = sum(
        4 * len(header["channels"]) * math.prod(_box(header, "dataWindow")[2:])
        for header in headers
    )
    if stored > _MAX_BYTES:
        raise Rejected(
            "too_many_pixels",
            f"its channels take {stored} bytes; expected at most {_MAX_BYTES}: write fewer layers",
        )


def _read_channels(
    data: bytes, headers: Sequence[Mapping[str, Any]], choice: _Choice
) -> NDArray[np.float32]:
    """Return the channels of a choice over its data window [H, W, C]."""
    parts = _read_parts(data, header_only=False)
    if len(parts) != len(headers):  # the library leaves parts out that it cannot read
        raise _cut_off_error()
    x_min, y_min, width, height = _box(headers[choice.part], "dataWindow")
    planes = []
    for name in choice.names:
        channel = parts[choice.part].channels[name]
        if not isinstance(channel.pixels, np.ndarray):
            raise _cut_off_error()
        plane = channel.pixels.astype(np.float32)
        across = _stretch(plane.T, x_min, width, channel.xSampling)
        planes.append(_stretch(across.T, y_min, height, channel.ySampling))
    return np.stack(planes, axis=-1)


def _stretch(
    plane: NDArray[np.float32], first: int, count: int, sampling: int
) -> NDArray[np.float32]:
    """Return rows at `count` coordinates from `first`, interpolated between stored rows."""
    if sampling == 1:
        return plane
    at = np.arange(first, first + count) / sampling - math.ceil(first / sampling)
    low = np.clip(np.floor(at).astype(np.int64), 0, len(plane) - 1)
    high = np.minimum(low + 1, len(plane) - 1)
    weight = np.clip(at - low, 0, 1)[:, None].astype(np.float32)
    return (1 - weight) * plane[low] + weight * plane[high]


def _crop_to_window(
    values: NDArray[np.float32], header: Mapping[str, Any], window: tuple[int, int, int, int]
) -> NDArray[np.float32]:
    """Return values [H, W, C] of the data window over another one, 0 where no pixel is stored."""
    x_min, y_min, width, height = window
    if (at := _box(header, "dataWindow")) == window:
        return values
    right = at[0] - x_min
    down = at[1] - y_min
    inside = values[max(-down, 0) : max(height - down, 0), max(-right, 0) : max(width - right, 0)]
    result = np.zeros((height, width, values.shape[2]), np.float32)
    result[max(down, 0) :, max(right, 0) :][: inside.shape[0], : inside.shape[1]] = inside
    return result


def _from_chroma(values: NDArray[np.float32], primaries: Sequence[float]) -> NDArray[np.float32]:
    """Convert BY, RY and Y to RGB; alpha stays."""
    by, ry, y = np.moveaxis(values[..., :3], -1, 0)
    weights = luminance_weights(primaries).astype(np.float32)
    red = (ry + 1) * y
    blue = (by + 1) * y
    green = (y - weights[0] * red - weights[2] * blue) / weights[1]
    return np.concatenate([np.stack([red, green, blue], axis=-1), values[..., 3:]], axis=-1)


def _read_primaries(header: Mapping[str, Any]) -> Sequence[float]:
    """Return the primaries [8] that a header states.

    Raises:
        Rejected: load_error: it names a color space that is not linear.
    """
    if "chromaticities" in header:
        return tuple(float(value) for value in header["chromaticities"])
    named = str(header.get("colorInteropID") or "")
    if not named and header.get("acesImageContainerFlag") == 1:
        named = "lin_ap0_scene"
    named = named or _SPACES.get(str(header.get("oiio:ColorSpace", "")).lower(), "")
    known = OpenEXR.colorInteropIDToChromaticities(named) if named else None
    if known is None and named.lower() not in _LINEAR:
        raise Rejected(
            "load_error", f"its color space is {named!r:.40}; write it in linear Rec.709"
        )
    return REC709 if known is None else tuple(float(value) for value in known)


def _list_unread(headers: Sequence[Mapping[str, Any]], choice: _Choice) -> Iterator[str]:
    unread_channels = [
        name
        for part, header in enumerate(headers)
        for name in (str(channel.name) for channel in header["channels"])
        if part != choice.part or name not in choice.names
    ]
    if unread_channels:
        yield f"channels {_list_names(unread_channels)}"
    header = headers[choice.part]
    space = str(header.get("oiio:ColorSpace", "")).lower()
    if space not in (*_LINEAR, *_SPACES) and "lin_rec709" not in space:
        yield f"color space {header['oiio:ColorSpace']!r:.40} of OpenImageIO"
    unread_attributes = {name for name in header if name not in _USED | _SAYS_NOTHING}
    if header.get("pixelAspectRatio", 1.0) == 1.0:
        unread_attributes -= {"pixelAspectRatio"}
    if unread_attributes:
        yield f"header attributes {_list_names(sorted(unread_attributes))}"


def _list_names(names: Iterable[str]) -> str:
    quoted = [f"{name!r:.40}" for name in names]
    more = f" and {len(quoted) - 6} more" if len(quoted) > 6 else ""
    return ", ".join(quoted[:6]) + more
