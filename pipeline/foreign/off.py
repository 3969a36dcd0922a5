"""The mesh of an OFF, by the text of Geomview: OFF, COFF, NOFF, STOFF, 4OFF, nOFF and both."""

import re
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.mesh import FileMesh, TriangleMesh, decode_colors
from pipeline.foreign.polygons import cut_polygons
from pipeline.foreign.text import TextLines, list_some, parse_numbers, plain_text, split_lines
from storage.errors import Rejected

_HEADER = re.compile(rb"\s*((?:ST|[CN4n])*)(?:OFF|off)(?![A-Za-z])(\s+BINARY)?|\s*(?=\d)")
_COLOR_COUNTS = (0, 1, 3, 4)


def read_off(data: bytes) -> FileMesh:
    """Return the triangles of an OFF with their colors.

    Raises:
        Rejected: load_error, header_size_mismatch or index_range.
    """
    text = re.sub(rb"#[^\n]*", b"", plain_text(data))
    header = _HEADER.match(text)
    if not header:
        raise Rejected("load_error", "the file does not begin with OFF or with its counts")
    if header[2]:
        raise Rejected("load_error", "the OFF is binary; expected text. Save it as text")
    flags = header[1] or b""
    body = split_lines(text[header.end() :])
    rows = np.flatnonzero(body.counts)
    numbers = parse_numbers(body.text, len(body.words), np.float64)
    skipped = 0
    if b"n" in flags:
        if not len(numbers) or numbers[0] != 3:
            raise Rejected("load_error", "the nOFF has no three dimensions; expected 3")
        skipped = 1
    return _Reader(flags, body, rows, numbers, skipped).read()


class _Reader:
    """Reads what follows the header."""

    def __init__(
        self,
        flags: bytes,
        body: TextLines,
        rows: NDArray[np.int64],
        numbers: NDArray[np.float64],
        skipped: int,
    ) -> None:
        self._flags, self._numbers = flags, numbers
        counts = body.counts[rows]
        ends = np.cumsum(counts)
        with_counts = int(np.searchsorted(ends, skipped, side="right")) if len(rows) else 0
        stated = int(ends[with_counts]) - skipped if with_counts < len(rows) else 0
        taken = 2 if stated == 2 else 3
        if len(numbers) < skipped + taken:
            raise Rejected("load_error", "the OFF has no counts of vertices and faces")
        head = numbers[skipped : skipped + taken]
        if not ((head >= 0) & (head < 1e15) & (head == np.floor(head))).all():
            raise Rejected("load_error", f"the OFF has the counts {head.tolist()}")
        self._num_points, self._num_faces = int(head[0]), int(head[1])
        self._at = skipped + taken
        self._is_by_line = stated == taken
        self._starts = (ends - counts)[with_counts + 1 :]
        self._counts = counts[with_counts + 1 :]
        self._dims = 4 if b"4" in flags else 3
        self._width = self._dims + 3 * (b"N" in flags) + 4 * (b"C" in flags) + 2 * (b"ST" in flags)
        self._unread = Counter[str]()
        last = body.text.rstrip(b" ").removesuffix(b"\n\n\n")
        self._is_open = not last.endswith(b"\n")

    def read(self) -> FileMesh:
        """Return the mesh."""
        rows = self._num_points + self._num_faces
        if rows > len(self._numbers):
            raise _cut_off(rows, len(self._numbers))
        if self._is_by_line and len(self._counts) >= rows:
            widths = self._counts[: self._num_points]
            if (widths >= self._dims).all():
                return self._read_lines(widths)
        return self._read_words()

    def _read_lines(self, widths: NDArray[np.int64]) -> FileMesh:
        points = self._points(self._starts[: self._num_points])
        begin = self._starts[self._num_points :][: self._num_faces]
        width = self._counts[self._num_points :][: self._num_faces]
        sizes = self._whole(self._numbers[begin])
        more = width - 1 - sizes
        if (more < 0).any():
            raise _cut_off(self._num_faces, int((more >= 0).sum()))
        ends_early = self._is_open and len(more) > 1 and more[-1] < more[-2]
        if not np.isin(more, _COLOR_COUNTS).all() or ends_early:
            raise Rejected("header_size_mismatch", "a face of the OFF has too few or many numbers")
        if len(self._counts) > self._num_points + self._num_faces:
            self._unread["lines after the last face"] = 1
        by_vertex = self._vertex_colors(widths)
        by_face = self._face_colors(begin + 1 + sizes, more)
        return self._mesh(points, begin + 1, sizes, by_vertex, by_face)

    def _read_words(self) -> FileMesh:
        """Read a file whose lines end anywhere: it has no colors of faces."""
        starts = self._at + self._width * np.arange(self._num_points)
        at = self._at + self._width * self._num_points
        begin, sizes = np.zeros((2, self._num_faces), np.int64)
        for row in range(self._num_faces):
            size = self._numbers[at] if at < len(self._numbers) else 0.0
            if not (1 <= size <= len(self._numbers) and size.is_integer()):
                raise _cut_off(self._num_faces, row)
            begin[row], sizes[row] = at + 1, size
            at += 1 + int(sizes[row])
        if at != len(self._numbers):
            raise _cut_off(self._num_points + self._num_faces, len(self._counts))
        widths = np.full(self._num_points, self._width)
        self._starts = starts
        return self._mesh(self._points(starts), begin, sizes, self._vertex_colors(widths), None)

    def _points(self, starts: NDArray[np.int64]) -> NDArray[np.float64]:
        points = self._numbers[starts[:, None] + np.arange(self._dims)]
        return points[:, :3] / points[:, 3:] if self._dims == 4 else points

    def _whole(self, values: NDArray[np.float64]) -> NDArray[np.int64]:
        whole = np.clip(values, -1, 2**62)
        if not ((whole >= 0) & (whole == np.floor(whole))).all():
            raise Rejected("load_error", "a face of the OFF does not begin with its size")
        return whole.astype(np.int64)

    def _vertex_colors(self, widths: NDArray[np.int64]) -> NDArray[np.float64] | None:
        """Return the linear colors [V, 3] of a COFF."""
        others = self._dims + 3 * (b"N" in self._flags) + 2 * (b"ST" in self._flags)
        more = widths - others
        if b"C" not in self._flags or not np.isin(more, (3, 4)).all() or not len(more):
            if (more != 0).any():
                self._unread["more numbers of vertices"] = int((more != 0).sum())
            return None
        first = self._starts[: len(widths)] + self._dims + 3 * (b"N" in self._flags)
        return decode_colors(self._numbers[first[:, None] + np.arange(3)])

    def _face_colors(
        self, first: NDArray[np.int64], more: NDArray[np.int64]
    ) -> NDArray[np.float64] | None:
        """Return the linear colors [F, 3] of faces, white where one has none."""
        if (more == 1).any():
            self._unread["colors of faces by their number in a map"] = int((more == 1).sum())
        has = more >= 3
        if not has.any():
            return None
        colors = np.ones((len(more), 3))
        colors[has] = decode_colors(self._numbers[first[has, None] + np.arange(3)])
        return colors

    def _mesh(
        self,
        points: NDArray[np.float64],
        begin: NDArray[np.int64],
        sizes: NDArray[np.int64],
        by_vertex: NDArray[np.float64] | None,
        by_face: NDArray[np.float64] | None,
    ) -> FileMesh:
        within = np.arange(int(sizes.sum())) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        named = self._numbers[np.repeat(begin, sizes) + within]
        if not (named == np.floor(named)).all():
            raise Rejected("load_error", "a face of the OFF names no whole number")
        indices = np.clip(named, -1, 2**62).astype(np.int64)
        cut = cut_polygons(points, sizes, indices, self._unread)
        return FileMesh(
            mesh=TriangleMesh(positions=points, faces=cut.vertices),
            color=cut.spread(by_vertex, by_face),
            unread=list_some(self._unread),
        )


def _cut_off(expected: int, present: int) -> Rejected:
    return Rejected(
        "header_size_mismatch", f"the OFF counts {expected} rows; the file holds {present}"
    )
