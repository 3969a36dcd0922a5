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
    dims = 3 + (b"4" in flags)  # the fourth is a divisor
    colors_at = dims + 3 * (b"N" in flags)
    width = colors_at + 4 * (b"C" in flags) + 2 * (b"ST" in flags)
    numbers, starts, widths, num_points = _find_rows(
        text[header.end() :], int(b"n" in flags), dims, width
    )
    vertices, faces = np.split(starts, [num_points])
    vertex_widths, face_widths = np.split(widths, [num_points])
    sizes = numbers[faces].astype(np.int64)

    def take(first: NDArray[np.int64], count: int) -> NDArray[np.float64]:
        """Return `count` numbers [N, count] from each position [N] on."""
        return numbers[first[:, None] + np.arange(count)]

    points = take(vertices, dims)
    if dims == 4:
        points = points[:, :3] / points[:, 3:]
    within = np.arange(int(sizes.sum())) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    indices = numbers[np.repeat(faces + 1, sizes) + within]
    if not (indices == np.floor(indices)).all():
        raise Rejected("load_error", "a face of the OFF names no whole number")
    unread = Counter[str]()
    cut = cut_polygons(points, sizes, np.clip(indices, -1, 2**62).astype(np.int64), unread)
    more = face_widths - 1 - sizes
    has = (more == 3) | (more == 4)
    if num_unread := int(((more > 0) & ~has).sum()):  # such as rows of a map of colors
        unread["more numbers of faces"] = num_unread
    by_vertex = by_face = None
    if b"C" in flags and num_points and (vertex_widths >= width - 1).all():
        by_vertex = decode_colors(take(vertices + colors_at, 3))
    else:
        if num_unread := int((vertex_widths != width).sum()):
            unread["more numbers of vertices"] = num_unread
        if has.any():
            by_face = np.ones((len(has), 3))
            by_face[has] = decode_colors(take(faces[has] + 1 + sizes[has], 3))
    return FileMesh(
        mesh=TriangleMesh(positions=points, faces=cut.vertices),
        color=cut.spread_colors(by_vertex, by_face),
        unread=list_some(unread),
    )


def _find_rows(
    text: bytes, before: int, dims: int, width: int
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64], int]:
    """Return all numbers, the positions [V + F] and widths [V + F] of rows, and V.

    Rows are those of vertices, then of faces: one a line, or separated by any white space.

    Args:
        text: the file without its key word.
        before: number of numbers before the counts.
        dims: coordinates of a vertex.
        width: numbers of a vertex.
    """
    _, starts, widths = find_lines(text)
    numbers = parse_numbers(text, int(widths.sum()), np.float64)
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
        more = widths[num_points:] - 1 - numbers[starts[num_points:]]
        is_open = not text.rstrip(b" ").endswith(b"\n")
        if (more < 0).any() or (is_open and len(more) > 1 and more[-1] < more[-2]):
            raise _cut_off_error(num_faces, int((more >= 0).sum()))
    else:
        starts, widths = _find_words(numbers, before + len(head), width, num_points, num_faces)
    sizes = numbers[starts[num_points:]]
    if not ((sizes >= 0) & (sizes == np.floor(sizes))).all():
        raise Rejected("load_error", "a face of the OFF does not begin with its size")
    return numbers, starts, widths, num_points


def _find_words(
    numbers: NDArray[np.float64], at: int, width: int, num_points: int, num_faces: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return where rows begin, regardless of line breaks, and their widths."""
    starts = at + width * np.arange(num_points + num_faces)
    at += width * num_points
    for row in range(num_faces):
        size = float(numbers[at]) if at < len(numbers) else 0.0
        if not (1 <= size <= len(numbers) and size.is_integer()):
            raise _cut_off_error(num_faces, row)
        starts[num_points + row] = at
        at += 1 + int(size)
    if at != len(numbers):
        raise _cut_off_error(num_points + num_faces, num_points)
    return starts, np.diff(starts, append=at)


def _cut_off_error(expected: int, present: int) -> Rejected:
    return Rejected(
        "header_size_mismatch", f"the OFF counts {expected} rows; the file holds {present}"
    )
