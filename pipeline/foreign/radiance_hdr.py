"""Radiance pictures (`.hdr`, `.pic`, RGBE) as linear radiance in Rec.709.

It is decoded here because no other reader serves: Mitsuba's writes beyond its memory for a file
whose rows are damaged, and Pillow has none. A value is mantissa / 256 x 2^(exponent - 128), divided
by the product of all EXPOSURE and COLORCORR lines.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.linear_picture import LinearPicture, are_rec709, as_rec709, require_pixels
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


@dataclass(frozen=True, kw_only=True)
class _Header:
    """The header, which precedes the pixels."""

    rows: int
    """Number of scanlines in the file."""
    columns: int
    is_column_major: bool
    """True where a scanline is a column."""
    flips: tuple[bool, bool]
    """True for rows that go up, and for columns to the left, once scanlines are rows."""
    start: int
    """Offset of the first pixel in bytes."""
    factors: NDArray[np.float64]
    """[3] factors of the stored values, which are divided out."""
    primaries: tuple[float, ...]
    unread: tuple[str, ...]


def read_radiance_hdr(data: bytes, max_pixels: int, *, is_color: bool) -> LinearPicture:
    """Return the picture of a file, RGB; arguments as for `read_linear_picture`.

    Raises:
        Rejected: not_hdr, too_many_pixels, load_error.
    """
    header = _read_header(data)
    rows = header.rows
    columns = header.columns
    require_pixels(columns, rows, max_pixels)
    if len(data) - header.start < 4 * rows:  # no row is shorter, with or without runs
        raise _damage_error("it is cut off")
    texels = _decode_texels(data, header.start, rows, columns)
    scale = np.ldexp(np.float32(1), texels[..., 3:].astype(np.int32) - 136)
    values = np.where(texels[..., 3:] > 0, texels[..., :3] * scale, 0).astype(np.float32)
    if (header.factors != 1).any():
        values = (values / header.factors).astype(np.float32)
    is_usual = np.allclose(header.primaries, _RADIANCE, rtol=0, atol=1e-3)
    if is_color and not is_usual and not are_rec709(header.primaries):
        values = as_rec709(values, header.primaries)
    if header.is_column_major:
        values = values.transpose(1, 0, 2)
    up, leftwards = header.flips
    values = values[:: -1 if up else 1, :: -1 if leftwards else 1]
    return LinearPicture(values=np.ascontiguousarray(values), unread=header.unread)


def _read_header(data: bytes) -> _Header:
    header = _HEADER.match(data[:_MOST_HEADER])
    if header is None:
        raise Rejected("not_hdr", "it is cut off within its header")
    line = header[2].rstrip(b"\r")
    size = _SIZE.fullmatch(line)
    if size is None or size[2] == size[5]:
        raise Rejected("not_hdr", f"its size is {line[:40]!r}; expected one such as -Y 512 +X 1024")
    factors = np.ones(3)
    primaries = _RADIANCE
    unread: dict[str, None] = {}
    for name, value in _variables((header[1] or b"").split(b"\n")):
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
    signs = {size[2]: size[1], size[5]: size[4]}
    return _Header(
        rows=int(size[3]),
        columns=int(size[6]),
        is_column_major=size[2] == b"X",
        flips=(signs[b"Y"] == b"+", signs[b"X"] == b"-"),
        start=header.end(),
        factors=factors,
        primaries=primaries,
        unread=tuple(unread),
    )


def _variables(lines: Sequence[bytes]) -> Iterator[tuple[str, str]]:
    for line in lines:
        match = None if line.startswith(b"#") else _VARIABLE.fullmatch(line)
        if match is not None:  # other lines are comments, or commands that made the picture
            yield match[1].decode(), match[2].decode("latin-1")


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
        if _SHORTEST <= columns <= _LONGEST and data[at : at + 4] == mark:
            at = _decode_runs(data, at + 4, texels[row])
        elif (
            _SHORTEST <= columns <= _LONGEST
            and data[at : at + 2] == mark[:2]
            and data[at + 2 : at + 3] < b"\x80"
        ):
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
