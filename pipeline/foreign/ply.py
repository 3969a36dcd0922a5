"""Reader of PLY meshes: any elements, properties, types and lists of a header, text or binary."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.mesh import FileMesh, TriangleMesh, decode_colors
from pipeline.foreign.polygons import CutPolygons, cut_polygons
from pipeline.foreign.text import decode_name, find_words, list_some, parse_numbers
from storage.errors import Rejected

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8"},
    **{"float32": "f4", "float64": "f8"},
}
Order = Literal["<", ">"]
_ORDERS: Mapping[bytes, Order | None] = {
    b"ascii": None,
    b"binary_little_endian": "<",
    b"binary_big_endian": ">",
}
_MAX_HEADER_BYTES = 1 << 20
_INDICES = ("vertex_indices", "vertex_index")
_COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), tuple("rgb"))
_UVS = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"), ("texture_s", "texture_t"))
_SILENT = {"x", "y", "z", "nx", "ny", "nz"}


@dataclass(frozen=True, kw_only=True)
class _Property:
    name: str
    kind: np.dtype
    count: np.dtype | None = None
    """Type of the count before a list; None for a single value."""


@dataclass(frozen=True, kw_only=True)
class _Element:
    name: str
    rows: int
    properties: list[_Property] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class _Header:
    order: Order | None
    """Byte order; None for text."""
    elements: Sequence[_Element]
    pictures: Sequence[str]
    size: int
    """Bytes of the header, after which the data begin."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Lists:
    """The values of a list property, one list after the other."""

    values: NDArray
    counts: NDArray[np.int64]


def read_ply(data: bytes) -> FileMesh:
    """Return the triangles of a PLY with its colors and texture coordinates.

    Raises:
        Rejected: load_error, header_size_mismatch or index_range.
    """
    header = _read_header(data)
    elements, rest = _read_elements(data, header)
    notes = Counter({"bytes after the last element": 1} if rest else {})
    vertex = elements.get("vertex", {})
    face = elements.get("face", {})
    coordinates = _take(vertex, "x", "y", "z")
    if coordinates is None:
        raise Rejected("load_error", "the PLY has no vertices with x, y and z")
    points = np.stack(coordinates, axis=1).astype(np.float64)
    polygons = _read_polygons(face)
    strips = _cut_strips(_read_polygons(elements.get("tristrips", {})))
    indices = np.concatenate([polygons.values.astype(np.int64), strips.ravel()])
    counts = np.concatenate([polygons.counts, np.full(len(strips), 3)])
    cut = cut_polygons(points, counts, indices, notes)
    by_vertex = _read_colors(vertex, notes)
    by_face = _read_colors(face, notes) if by_vertex is None else None
    if by_face is not None:
        by_face = np.concatenate([by_face, np.ones((len(strips), 3))])
    number = _take(face, "texnumber") or [np.zeros(len(polygons.counts))]
    rows = np.append(number[0].astype(np.int64), np.full(len(strips), -1))[cut.owner]
    uv = _read_uv(vertex, face, polygons, cut)
    return FileMesh(
        mesh=TriangleMesh(positions=points, faces=cut.vertices),
        material=np.where((rows >= 0) & (rows < len(header.pictures)), rows, -1),
        material_names=tuple(header.pictures),
        uv=uv,
        color=cut.spread_colors(by_vertex, by_face),
        is_single=any(one.dtype == np.float32 for one in coordinates),
        unread=list_some(notes | Counter(_list_unread(elements))),
    )


def check_face_count(data: bytes, max_faces: int) -> None:
    """Raise Rejected for a header that counts too many faces, or as `read_ply` for a malformed one.

    A count that the file cannot hold is left to `read_ply`.
    """
    for element in _read_header(data).elements:
        if element.name == "face" and max_faces < element.rows <= len(data):
            raise Rejected("too_many_faces", f"{element.rows} faces; expected <= {max_faces}")


def list_ply_pictures(data: bytes) -> Sequence[str]:
    """Return the names of the pictures of a PLY; raises Rejected as `check_face_count`."""
    return _read_header(data).pictures


def _read_header(data: bytes) -> _Header:
    data = data.removeprefix(b"\xef\xbb\xbf")[:_MAX_HEADER_BYTES]
    begin = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data)
    if not begin:
        raise Rejected("load_error", "the PLY header has no beginning")
    form: bytes = b""
    elements: list[_Element] = []
    pictures: list[str] = []
    size = begin.end()
    for row in data[size:].split(begin[1])[:-1]:
        size += len(row) + len(begin[1])
        line = row.strip()
        words = line.split()
        key = words[0] if words else b"comment"
        if key == b"end_header":
            break
        if key == b"format" and len(words) > 1:
            form = words[1]
        elif key in (b"comment", b"obj_info"):
            if picture := re.match(rb"(?i)\w+\s+TextureFile\s+(.+)", line):
                pictures.append(decode_name(picture[1]))
        elif key == b"element" and len(words) == 3:
            if not re.fullmatch(rb"\d{1,18}", words[2]):
                counted = words[2][:24]
                raise Rejected("header_size_mismatch", f"the PLY header counts {counted!r}")
            elements.append(_Element(name=decode_name(words[1]), rows=int(words[2])))
        elif key == b"property" and elements and len(words) in (3, 5):
            elements[-1].properties.append(_read_property(words))
        else:
            raise Rejected("load_error", f"the PLY header has the line {line[:60]!r}")
    else:
        raise Rejected("header_size_mismatch", "the PLY ends within its header")
    if form not in _ORDERS:
        raise Rejected("load_error", f"the PLY is of the format {form[:24]!r}")
    return _Header(order=_ORDERS[form], elements=elements, pictures=pictures, size=size)


def _read_property(words: Sequence[bytes]) -> _Property:
    kinds = [_TYPES.get(word.decode("latin-1")) for word in words[1:-1] if word != b"list"]
    is_list = words[1] == b"list"
    if None in kinds or len(kinds) != 1 + is_list or (is_list and kinds[0] in ("f4", "f8")):
        raise Rejected("load_error", f"the PLY has a property {b' '.join(words)[:60]!r}")
    return _Property(
        name=decode_name(words[-1]).lower(),
        kind=np.dtype(kinds[-1]),
        count=np.dtype(kinds[0]) if is_list else None,
    )


Columns = dict[str, Any]
"""Columns by name: arrays, or `_Lists`; readers remove what they read."""


def _read_elements(data: bytes, header: _Header) -> tuple[dict[str, Columns], int]:
    """Return the columns of each element, and the number of bytes after the last one."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    codes = np.frombuffer(data, np.uint8)[header.size :]
    if not header.order:
        text = data[header.size :]
        codes = parse_numbers(text, len(find_words(text)), np.float64).view(np.uint8)
    columns: dict[str, Columns] = {}
    at = 0
    for element in header.elements:
        if element.properties:
            columns[element.name], at = _read_rows(codes, header.order, element, at)
    rest = len(codes) - at
    if rest and not header.order:
        raise Rejected("header_size_mismatch", f"the PLY holds {rest // 8} numbers too many")
    return columns, rest


def _read_rows(
    codes: NDArray[np.uint8], order: Order | None, element: _Element, at: int
) -> tuple[Columns, int]:
    """Return the columns of an element whose rows begin at position `at`, and their end."""
    kinds = [_storage_type(one.kind, order) for one in element.properties]
    counts = [one.count and _storage_type(one.count, order) for one in element.properties]
    heads = np.array([0 if count is None else count.itemsize for count in counts])
    sizes = np.array([kind.itemsize for kind in kinds])
    if element.rows * int(np.where(heads > 0, heads, sizes).sum()) > len(codes) - at:
        raise Rejected(
            "header_size_mismatch",
            f"the PLY header counts {element.rows} rows of {element.name[:24]!r}, which the file "
            "does not hold",
        )

    def place(lengths: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
        """Return the first position [rows, P] of each property, and the end of all."""
        steps = heads + sizes * lengths
        return at + np.cumsum(steps).reshape(steps.shape) - steps, at + int(steps.sum())

    def walk(rows: int) -> NDArray[np.int64]:
        """Return the numbers [rows, P] of values of the properties, row by row."""
        steps = list(zip(counts, heads.tolist(), sizes.tolist(), strict=True))
        lengths = np.ones((rows, len(steps)), np.int64)
        position = at
        for row in range(rows):
            for column, (count, head, size) in enumerate(steps):
                length = 1
                if count is not None:
                    word = codes[position : position + head]
                    length = int(word.view(count)[0]) if len(word) == head else -1
                    if not 0 <= length <= len(codes):
                        raise cut_off
                    lengths[row, column] = length
                position += head + size * length
        return lengths

    cut_off = Rejected("header_size_mismatch", f"the PLY ends within {element.name[:24]!r}")
    lengths = np.zeros((element.rows, len(kinds)), np.int64) + walk(min(element.rows, 1))
    begins, end = place(lengths)
    is_even = end <= len(codes) and all(
        (_gather(codes, begins[:, column], count) == lengths[:, column]).all()
        for column, count in enumerate(counts)
        if count is not None
    )
    if not is_even:  # the lists differ in length, and the rows are walked
        lengths = walk(element.rows)
        begins, end = place(lengths)
    if end > len(codes):
        raise cut_off
    columns: Columns = {}
    for one, kind, size, count, begin in zip(
        element.properties, kinds, sizes, lengths.T, (begins + heads).T, strict=True
    ):
        if one.count is not None:
            within = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
            begin = np.repeat(begin, count) + size * within
        values = _gather(codes, begin, kind).astype(one.kind)
        columns[one.name] = values if one.count is None else _Lists(values=values, counts=count)
    return columns, end


def _storage_type(kind: np.dtype, order: Order | None) -> np.dtype:
    """Return a type as the data hold it: all numbers of a text are doubles."""
    return kind.newbyteorder(order) if order else np.dtype(np.float64)


def _gather(codes: NDArray[np.uint8], at: NDArray[np.int64], kind: np.dtype) -> NDArray:
    """Return the numbers [N] of a type that begin at positions [N]."""
    return codes[at[:, None] + np.arange(kind.itemsize)].view(kind)[:, 0]


def _take(columns: Columns, *names: str) -> list[NDArray] | None:
    """Remove columns of single values from those that are unread; None where one is missing."""
    if not all(isinstance(columns.get(name), np.ndarray) for name in names):
        return None
    return [columns.pop(name) for name in names]


def _take_lists(columns: Columns, *names: str) -> _Lists | None:
    """Remove the first list column among these names from those that are unread."""
    name = next((name for name in names if isinstance(columns.get(name), _Lists)), None)
    return None if name is None else columns.pop(name)


def _list_unread(elements: Mapping[str, Columns]) -> Iterator[str]:
    """Yield sentences on the elements and properties that are left."""
    for element, columns in elements.items():
        if element not in ("vertex", "face", "tristrips"):
            yield f"element {element[:24]!r}"
        else:
            unread = (name for name in columns if name not in _SILENT)
            yield from (f"property {name[:24]!r} of {element}" for name in unread)


def _read_polygons(columns: Columns) -> _Lists:
    """Return the vertices of faces or strips."""
    names = [name for name, values in columns.items() if isinstance(values, _Lists)]
    lists = _take_lists(columns, *_INDICES, *(names if len(names) == 1 else ()))
    return lists or _Lists(values=np.zeros(0, np.int64), counts=np.zeros(0, np.int64))


def _cut_strips(strips: _Lists) -> NDArray[np.int64]:
    """Return the triangles [T, 3] of strips; -1 starts a new strip, every second one is flipped."""
    values = strips.values.astype(np.int64)
    piece = np.repeat(np.arange(len(strips.counts)), strips.counts) + np.cumsum(values == -1)
    is_vertex = values != -1
    values = values[is_vertex]
    piece = piece[is_vertex]
    _, first = np.unique(piece, return_index=True)
    position = np.arange(len(values)) - np.repeat(first, np.diff(np.append(first, len(values))))
    same = np.flatnonzero(piece[2:] == piece[:-2])
    turned = position[same] % 2
    return np.stack([values[same + turned], values[same + 1 - turned], values[same + 2]], axis=1)


def _read_colors(columns: Columns, notes: Counter[str]) -> NDArray[np.float64] | None:
    """Return the linear colors [N, 3] of vertices or faces."""
    for names in _COLORS:
        if (values := _take(columns, *names)) is not None:
            alpha = _take(columns, "alpha") or _take(columns, "a")
            if alpha is not None and (decode_colors(alpha[0]) < 1).any():
                notes["transparency of colors"] = 1
            return decode_colors(np.stack(values, axis=1))
    return None


def _read_uv(
    vertex: Columns, face: Columns, polygons: _Lists, cut: CutPolygons
) -> NDArray[np.float64] | None:
    """Return texture coordinates [T, 3, 2] of corners: of faces, or else of vertices."""
    lists = _take_lists(face, "texcoord")
    if lists is not None and len(lists.values):
        uv = np.full((max(int(cut.corners.max(initial=-1)) + 1, len(polygons.values)), 2), np.nan)
        has = lists.counts == 2 * polygons.counts
        corner_mask = np.repeat(has, polygons.counts)
        value_mask = np.repeat(has, lists.counts)
        uv[: len(polygons.values)][corner_mask] = lists.values[value_mask].reshape(-1, 2)
        return uv[cut.corners]
    for names in _UVS:
        if (values := _take(vertex, *names)) is not None:
            return np.stack(values, axis=1).astype(np.float64)[cut.vertices]
    return None
