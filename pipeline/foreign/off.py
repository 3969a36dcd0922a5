"""Reader of OFF meshes in the text form of Geomview: any of ST, C, N, 4 and n before OFF."""

import re
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.mesh import FileMesh, TriangleMesh, decode_colors
from pipeline.foreign.polygons import cut_polygons
from pipeline.foreign.text import find_lines, list_some, parse_numbers, plain_text
from storage.errors import Rejected

_HEADER = re.compile(rb"\s*((?:ST|[CN4n])*)(?:OFF|off)(?![A-Za-z])(\s+BINARY)?|\s*(?=\d)")


def read_off(data: bytes) -> FileMesh:
    """Return the triangles of an OFF with their colors.

    Raises:
        Rejected: load_error, header_size_mismatch or index_range.
    """
    text = re.sub(rb"#[^\n]*", b"", plain_text(data))
    header = _HEADER.match(text)
    if not header or header[2]:
        state = "is binary" if header else "does not begin with OFF or with its counts"
        raise Rejected("load_error", f"the OFF {state}; expected text. Save it as text")
    flags = header[1] or b""
    rows = _Rows(text[header.end() :], flags)
    points = rows.take(rows.points, rows.dims)
    if rows.dims == 4:
        points = points[:, :3] / points[:, 3:]
    within = np.arange(int(rows.sizes.sum())) - np.repeat(
        np.cumsum(rows.sizes) - rows.sizes, rows.sizes
    )
    indices = rows.numbers[np.repeat(rows.faces + 1, rows.sizes) + within]
    if not (indices == np.floor(indices)).all():
        raise Rejected("load_error", "a face of the OFF names no whole number")
    unread = Counter[str]()
    cut = cut_polygons(points, rows.sizes, np.clip(indices, -1, 2**62).astype(np.int64), unread)
    color = cut.spread_colors(*rows.read_colors(flags, unread))
    mesh = TriangleMesh(positions=points, faces=cut.vertices)
    return FileMesh(mesh=mesh, color=color, unread=list_some(unread))


class _Rows:
    """The rows of an OFF, one a line or separated by any white space, by their numbers."""

    def __init__(self, text: bytes, flags: bytes) -> None:
        _, starts, widths = find_lines(text)
        self.numbers = numbers = parse_numbers(text, int(widths.sum()), np.float64)
        self.dims = dims = 3 + (b"4" in flags)
        """Coordinates of a vertex: 3, or 4 with a divisor."""
        self._width = width = (
            dims + 3 * (b"N" in flags) + 4 * (b"C" in flags) + 2 * (b"ST" in flags)
        )
        before = int(b"n" in flags)  # the number of dimensions
        row = int(np.searchsorted(starts, before, side="right")) - 1
        stated = int(starts[row] + widths[row]) - before if len(starts) else 0
        head = numbers[before : before + (2 if stated == 2 else 3)]
        is_count = (head >= 0) & (head < 1e15) & (head == np.floor(head))
        if len(head) < 2 or not is_count.all() or (before and numbers[0] != 3):
            raise Rejected("load_error", f"the OFF has the counts {numbers[:4].tolist()}")
        num_points = int(head[0])
        num_faces = int(head[1])
        if num_points + num_faces > len(numbers):
            raise _cut_off_error(num_points + num_faces, len(widths) - 1)
        rows = slice(row + 1, row + 1 + num_points + num_faces)
        starts = starts[rows]
        widths = widths[rows]
        by_line = stated == len(head) and len(widths) == num_points + num_faces
        if by_line and (widths[:num_points] >= dims).all():
            sizes = numbers[starts[num_points:]]
            more = widths[num_points:] - 1 - sizes
            is_open = not text.rstrip(b" ").endswith(b"\n")
            if (more < 0).any() or (is_open and len(more) > 1 and more[-1] < more[-2]):
                raise _cut_off_error(num_faces, int((more >= 0).sum()))
        else:
            starts, sizes = _find_words(numbers, before + len(head), width, num_points, num_faces)
            widths = np.full(num_points, width)
            more = np.zeros(num_faces)
        if not ((sizes >= 0) & (sizes == np.floor(sizes))).all():
            raise Rejected("load_error", "a face of the OFF does not begin with its size")
        self.points = starts[:num_points]
        """[V] position of the first number of each vertex."""
        self._widths = widths[:num_points]
        self.faces = starts[num_points:]
        """[F] position of the number that states the size of each face."""
        self.sizes = sizes.astype(np.int64)
        """[F] count of corners of each face."""
        self._more = more.astype(np.int64)  # [F] count of numbers after the corners

    def take(self, first: NDArray[np.int64], count: int) -> NDArray[np.float64]:
        """Return `count` numbers [N, count] from each position [N] on."""
        return self.numbers[first[:, None] + np.arange(count)]

    def read_colors(
        self, flags: bytes, unread: Counter[str]
    ) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
        """Return the linear colors of vertices [V, 3], or else of faces [F, 3]."""
        has = (self._more == 3) | (self._more == 4)
        if num_unread := int(((self._more > 0) & ~has).sum()):  # such as rows of a map of colors
            unread["more numbers of faces"] = num_unread
        if b"C" in flags and len(self._widths) and (self._widths >= self._width - 1).all():
            first = self.points + self.dims + 3 * (b"N" in flags)
            return decode_colors(self.take(first, 3)), None
        if num_unread := int((self._widths != self._width).sum()):
            unread["more numbers of vertices"] = num_unread
        if not has.any():
            return None, None
        by_face = np.ones((len(has), 3))
        by_face[has] = decode_colors(self.take(self.faces[has] + 1 + self.sizes[has], 3))
        return None, by_face


def _find_words(
    numbers: NDArray[np.float64], at: int, width: int, num_points: int, num_faces: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return where rows begin, regardless of line breaks, and the sizes of the faces."""
    starts = at + width * np.arange(num_points)
    at += width * num_points
    begin = np.zeros(num_faces, np.int64)
    sizes = np.zeros(num_faces)
    for row in range(num_faces):
        size = float(numbers[at]) if at < len(numbers) else 0.0
        if not (1 <= size <= len(numbers) and size.is_integer()):
            raise _cut_off_error(num_faces, row)
        begin[row] = at
        sizes[row] = size
        at += 1 + int(size)
    if at != len(numbers):
        raise _cut_off_error(num_points + num_faces, num_points)
    return np.concatenate([starts, begin]), sizes


def _cut_off_error(expected: int, present: int) -> Rejected:
    return Rejected(
        "header_size_mismatch", f"the OFF counts {expected} rows; the file holds {present}"
    )
