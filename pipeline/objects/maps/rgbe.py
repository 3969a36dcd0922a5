"""Radiance pictures (`.hdr`, RGBE) as linear radiance.

Decoded here because the readers at hand will not do: Mitsuba's writes beyond its memory for a file
whose rows are damaged, and Pillow has none. A value is mantissa / 256 x 2^(exponent - 128).
"""

import re

import numpy as np
from numpy.typing import NDArray

from storage.errors import Rejected

_MOST_HEADER = 1 << 16
_SIZE = re.compile(rb"-Y (\d{1,5}) \+X (\d{1,5})")
_SCALED = re.compile(rb"(EXPOSURE|COLORCORR)\s*=")
_SHORTEST, _LONGEST = 8, 32767
"""Widths between which rows may have run lengths."""
_LONG_RUN = 128


def rgbe_radiance(data: bytes, most_rows: int) -> NDArray[np.float32]:
    """Return the picture of a file [H, W, 3], the top row first.

    Args:
        data: the file.
        most_rows: most rows, and half of the most columns; known before memory is taken.

    Raises:
        Rejected: not_hdr, too_many_pixels, load_error.
    """
    rows, columns, start = _header(data)
    if not (0 < rows <= most_rows and 0 < columns <= 2 * most_rows):
        raise Rejected(
            "too_many_pixels",
            f"{columns} x {rows}; expected at most {2 * most_rows} x {most_rows}: scale it down",
        )
    if len(data) - start < rows * min(columns, 8):  # no row is shorter, with or without runs
        raise _damaged("it ends too early")
    texels = _texels(data, start, rows, columns)
    scale = np.ldexp(np.float32(1), texels[..., 3:].astype(np.int32) - 136)
    return np.where(texels[..., 3:] > 0, texels[..., :3] * scale, 0).astype(np.float32)


def _header(data: bytes) -> tuple[int, int, int]:
    """Return rows, columns, and where the pixels begin."""
    text, end, rest = data[:_MOST_HEADER].partition(b"\n\n")
    lines = text.split(b"\n")
    if not (end and lines[0].startswith(b"#?")):
        raise Rejected("not_hdr", "it does not begin as a Radiance picture; write it anew")
    if any(_SCALED.match(line) for line in lines):
        raise Rejected("not_hdr", "its header scales the values (EXPOSURE); write it without")
    if b"FORMAT=32-bit_rle_rgbe" not in lines:
        raise Rejected("not_hdr", "its header names no format 32-bit_rle_rgbe; write it as RGBE")
    line = rest.partition(b"\n")[0]
    size = _SIZE.fullmatch(line)
    if size is None:
        raise Rejected("not_hdr", "its rows are not from the top left (-Y +X); write them so")
    return int(size[1]), int(size[2]), len(text) + len(end) + len(line) + 1


def _texels(data: bytes, start: int, rows: int, columns: int) -> NDArray[np.uint8]:
    """Return [H, W, 4] mantissas and exponent."""
    found = np.zeros((rows, columns, 4), np.uint8)
    at, mark = start, bytes([2, 2, columns >> 8, columns & 255])
    for row in range(rows):
        if _SHORTEST <= columns <= _LONGEST and data[at : at + 4] == mark:
            at = _runs(data, at + 4, found[row])
            continue
        if data[at : at + 2] == mark[:2] and data[at + 2 : at + 3] < b"\x80":
            raise _damaged(f"row {row} is of another width")
        flat = np.frombuffer(data[at : at + 4 * columns], np.uint8)
        if len(flat) < 4 * columns:
            raise _damaged(f"row {row} is cut short")
        found[row] = flat.reshape(columns, 4)
        if (found[row, :, :3] == 1).all(axis=1).any():
            raise _damaged(f"row {row} has run lengths of the old kind")
        at += 4 * columns
    return found


def _runs(data: bytes, at: int, row: NDArray[np.uint8]) -> int:
    """Fill a row [W, 4] from its run lengths, and return where they end."""
    width = len(row)
    for channel in range(4):
        done = 0
        while done < width:
            if at + 1 >= len(data):
                raise _damaged("it ends within a row")
            count, is_run = data[at], data[at] > _LONG_RUN
            count -= _LONG_RUN if is_run else 0
            taken = data[at + 1 : at + 2 + (0 if is_run else count - 1)]
            if not 0 < count <= width - done or len(taken) != (1 if is_run else count):
                raise _damaged("a row has more or fewer values than it says")
            row[done : done + count, channel] = np.frombuffer(taken, np.uint8)
            done, at = done + count, at + 1 + len(taken)
    return at


def _damaged(why: str) -> Rejected:
    return Rejected("load_error", f"it is damaged or of another kind ({why}); write it anew")
