"""Radiance pictures (`.hdr`, `.pic`, RGBE) as linear radiance in Rec.709.

It is decoded here because no other reader serves: Mitsuba's writes beyond its memory for a file
whose rows are damaged, and Pillow has none. A value is mantissa / 256 x 2^(exponent - 128), divided
by the product of all EXPOSURE and COLORCORR lines.
"""

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.linear_picture import SAME, LinearPicture, as_rec709, require_pixels
from pipeline.foreign.numbers import Malformed, parse_number
from storage.errors import Rejected

MAGIC = b"#?"
"""First bytes of a Radiance file."""

_MOST_HEADER = 1 << 16
_HEADER = re.compile(rb"#\?[^\n]*\n(?:(.*?)\n)??\r*\n([^\n]*)\n", re.DOTALL)
"""The lines up to an empty one, and the line of the size."""
_SIZE = re.compile(rb"([-+])([XY])\s+(\d{1,6})\s+([-+])([XY])\s+(\d{1,6})\s*")
_VARIABLE = re.compile(rb"\s*([A-Z]+)\s*=\s*(.*?)\s*")
_SHORTEST = 8
_LONGEST = 32767
"""Widths of rows within which they may be run-length encoded."""
_LONG_RUN = 128
_RADIANCE = (0.640, 0.330, 0.290, 0.600, 0.150, 0.060, 0.3333, 0.3333)
"""Default primaries of the format; all programs show them as Rec.709, stated or not."""
_SAYS_NOTHING = frozenset("SOFTWARE OWNER CAPDATE GMT INSTRUMENT LATLONG DATE".split())


def read_radiance_hdr(data: bytes, max_pixels: int, *, is_color: bool) -> LinearPicture:
    """Return the picture of a file, RGB; arguments as for `read_linear_picture`.

    Raises:
        Rejected: not_hdr, too_many_pixels, load_error.
    """
    header = _HEADER.match(data[:_MOST_HEADER])
    if header is None:
        raise Rejected("not_hdr", "it is cut off within its header")
    line = header[2].rstrip(b"\r")
    size = _SIZE.fullmatch(line)
    if size is None or size[2] == size[5]:
        raise Rejected("not_hdr", f"its size is {line[:40]!r}; expected one such as -Y 512 +X 1024")
    factors, primaries, unread = _read_variables((header[1] or b"").split(b"\n"))
    rows = int(size[3])
    columns = int(size[6])
    require_pixels(columns, rows, max_pixels)
    if len(data) - header.end() < 4 * rows:  # no row is shorter, with or without runs
        raise _damage_error("it is cut off")
    texels = _decode_texels(data, header.end(), rows, columns)
    scale = np.ldexp(np.float32(1), texels[..., 3:].astype(np.int32) - 136)
    values = np.where(texels[..., 3:] > 0, texels[..., :3] * scale, 0).astype(np.float32)
    if (factors != 1).any():
        values = (values / factors).astype(np.float32)
    if is_color and not np.allclose(primaries, _RADIANCE, rtol=0, atol=SAME):
        values = as_rec709(values, primaries)
    if size[2] == b"X":  # a scanline is a column
        values = values.transpose(1, 0, 2)
    signs = {size[2]: size[1], size[5]: size[4]}
    values = values[:: -1 if signs[b"Y"] == b"+" else 1, :: -1 if signs[b"X"] == b"-" else 1]
    return LinearPicture(values=np.ascontiguousarray(values), unread=unread)


def _read_variables(
    lines: Sequence[bytes],
) -> tuple[NDArray[np.float64], tuple[float, ...], tuple[str, ...]]:
    """Return factors [3] of the stored values, primaries [8], and notes on unread variables."""
    factors = np.ones(3)
    primaries: tuple[float, ...] = _RADIANCE
    unread: dict[str, None] = {}
    for line in lines:
        variable = None if line.startswith(b"#") else _VARIABLE.fullmatch(line)
        if variable is None:  # a comment, or a command that made the picture
            continue
        name = variable[1].decode()
        value = variable[2].decode("latin-1")
        if name == "FORMAT":
            if value != "32-bit_rle_rgbe":
                raise Rejected("not_hdr", f"its format is {value!r:.40}; expected 32-bit_rle_rgbe")
        elif name in ("EXPOSURE", "COLORCORR"):
            factors = factors * _parse_numbers(value, 1 if name == "EXPOSURE" else 3, name)
        elif name == "PRIMARIES":
            numbers = tuple(_parse_numbers(value, 8, name))
            primaries = numbers if any(numbers) else primaries  # Photoshop states none as zeros
        elif name in ("PIXASPECT", "GAMMA") and (_parse_numbers(value, 1, name) == 1).all():
            continue
        elif name not in _SAYS_NOTHING:
            unread[f"header variable {name:.40}"] = None
    if not (np.isfinite(factors) & (factors > 0)).all():
        raise Rejected("not_hdr", f"its exposure is {factors.tolist()}; expected above 0")
    return factors, primaries, tuple(unread)


def _parse_numbers(text: str, count: int, name: str) -> NDArray[np.float64]:
    try:
        numbers = np.array([parse_number(word, name) for word in text.split()])
    except Malformed:
        numbers = np.zeros(0)
    if len(numbers) != count:
        raise Rejected("not_hdr", f"its {name} is {text!r:.60}; expected {count} numbers")
    return numbers


def _decode_texels(data: bytes, start: int, rows: int, columns: int) -> NDArray[np.uint8]:
    """Return mantissas and exponents [H, W, 4]."""
    texels = np.zeros((rows, columns, 4), np.uint8)
    at = start
    mark = bytes([2, 2, columns >> 8 & 255, columns & 255])
    for row in range(rows):
        head = data[at : at + 4] if _SHORTEST <= columns <= _LONGEST else b""
        if head == mark:
            at = _decode_runs(data, at + 4, texels[row])
        elif head[:2] == mark[:2] and head[2:3] < b"\x80":
            raise _damage_error(f"row {row} is cut off or of another width")
        else:
            at = _decode_old_runs(data, at, texels[row])
    return texels


def _decode_runs(data: bytes, at: int, row: NDArray[np.uint8]) -> int:
    """Fill a row [W, 4] from run lengths, and return the offset of their end."""
    width = len(row)
    for channel in range(4):
        done = 0
        while done < width:
            if at + 1 >= len(data):
                raise _damage_error("it is cut off within a row")
            count = data[at]
            is_run = data[at] > _LONG_RUN
            count -= _LONG_RUN if is_run else 0
            run = data[at + 1 : at + 2 + (0 if is_run else count - 1)]
            if not 0 < count <= width - done or len(run) != (1 if is_run else count):
                raise _damage_error("a row has more or fewer values than it says, or is cut off")
            row[done : done + count, channel] = np.frombuffer(run, np.uint8)
            done += count
            at += 1 + len(run)
    return at


def _decode_old_runs(data: bytes, at: int, row: NDArray[np.uint8]) -> int:
    """Fill a row [W, 4] from plain texels and old-style runs, and return the offset of their end.

    A texel (1, 1, 1, n) repeats the last one n times, and 256 n times where it follows a run.
    """
    width = len(row)
    texels = np.frombuffer(data[at : at + 4 * width], np.uint8)
    texels = texels[: len(texels) // 4 * 4].reshape(-1, 4)
    is_run = (texels[:, :3] == 1).all(axis=1)
    if is_run[:1].any():
        raise _damage_error("a row begins with a run")
    index = np.arange(len(texels))
    plain = np.maximum.accumulate(np.where(is_run, 0, index))
    level = np.minimum(index - plain - 1, 3)  # a run of the fourth level is beyond any width
    counts = np.where(is_run, texels[:, 3].astype(np.int64) << 8 * np.maximum(level, 0), 1)
    ends = np.cumsum(counts)
    last = int(np.searchsorted(ends, width))
    if last == len(ends):
        raise _damage_error("it is cut off within a row")
    if ends[last] != width:
        raise _damage_error("a run is longer than its row")
    row[:] = np.repeat(texels[plain[: last + 1]], counts[: last + 1], axis=0)
    return at + 4 * (last + 1)


def _damage_error(why: str) -> Rejected:
    return Rejected("load_error", f"it is damaged or of another kind ({why}); write it again")
