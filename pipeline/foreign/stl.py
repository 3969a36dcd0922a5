"""Reader of STL meshes: binary of the stated length, or text with any white space."""

import re
from collections import Counter

import numpy as np

from pipeline.foreign.mesh import FileMesh, TriangleMesh
from pipeline.foreign.polygons import cut_polygons
from pipeline.foreign.text import list_some, parse_numbers, plain_text
from storage.errors import Rejected

_HEADER_BYTES = 84
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_NAME = re.compile(
    rb"""(?x)
    ((?:\n|endfacet)[^\S\n]*) (?:solid|(end)solid)
    (?: [^\n]*? (?=
            [^\S\n]facet [^\S\n]+normal (?:[^\S\n]+[-+.\da-z#()]+){3}
            (?:[^\S\n]+outer[^\S\n] | [^\S\n]*\n))
        | [^\n]*)"""
)
"""The word that begins or ends a solid, and its name: to the end of the line, or to a facet."""
_LOOP = re.compile(rb"outer\s+loop((?:\s+vertex(?:\s+\S+){3})+)\s+endloop\s")
_AROUND_LOOP = re.compile(rb"facet(?:\s+normal(?:\s+(?!endfacet)\S+){0,3})?\s+endfacet\s")
_ENDS = re.compile(rb"(\n[ \t]*)end[ \t]+(?=(?:facet|loop|solid)\b)")
_WORDS = {b"facet", b"outer", b"loop", b"vertex"}


def count_facets(data: bytes) -> int | None:
    """Return the number of facets that a binary STL of the stated length has; None for others."""
    count = int.from_bytes(data[80:_HEADER_BYTES], "little")
    return count if len(data) == _HEADER_BYTES + _FACET.itemsize * count else None


def read_stl(data: bytes) -> FileMesh:
    """Return the triangles of an STL.

    Raises:
        Rejected: load_error, header_size_mismatch or cut_off.
    """
    count = int.from_bytes(data[80:_HEADER_BYTES], "little")
    more = len(data) - _HEADER_BYTES - _FACET.itemsize * count
    if more == 0:
        return _read_binary(data, count)
    text = plain_text(data)
    if text.lstrip()[:5].lower() == b"solid" and b"\0" not in text[:_HEADER_BYTES]:
        return _read_text(text.lower())
    if count and 0 < more < _FACET.itemsize:
        return _read_binary(data, count)
    raise Rejected(
        "header_size_mismatch",
        f"the STL is no text, which begins with solid, and its header counts {count} facets, "
        f"for which its {len(data)} bytes are {abs(more)} too {'many' if more > 0 else 'few'}",
    )


def _read_binary(data: bytes, count: int) -> FileMesh:
    facets = np.frombuffer(data, _FACET, count, _HEADER_BYTES)
    unread = Counter[str]()
    if len(data) > _HEADER_BYTES + facets.nbytes:
        unread["bytes after the last facet"] = 1
    if facets["attribute"].any():
        unread["attributes of facets, which often are colors"] = 1
    if b"COLOR=" in data[:80]:
        unread["color of the header"] = 1
    return FileMesh(
        mesh=_build_mesh(facets["corners"].reshape(-1, 3).astype(np.float64)),
        is_single=True,
        unread=list_some(unread),
    )


def _build_mesh(corners: np.ndarray) -> TriangleMesh:
    return TriangleMesh(positions=corners, faces=np.arange(len(corners)).reshape(-1, 3))


def _read_text(text: bytes) -> FileMesh:
    ends: list[bytes | None] = []

    def strip_name(name: re.Match[bytes]) -> bytes:
        ends.append(name[2])
        return name[1] + b" "

    text = _NAME.sub(strip_name, _ENDS.sub(rb"\1end", b"\n" + text + b"\n"))
    pieces = _LOOP.split(text)
    loops = pieces[1::2]
    rest = _AROUND_LOOP.sub(b" ", b" ".join(pieces[::2])).strip(b"\0\x1a \n").split()
    if 2 * ends.count(None) != len(ends) or (rest and b"solid".startswith(rest[-1])):
        raise Rejected("cut_off", "the STL ends within a facet, within solid, or without endsolid")
    broken = next((word for word in rest if word.removeprefix(b"end") in _WORDS), None)
    if broken is not None:
        why = f"the STL has {broken.decode()!r} where a facet is not complete"
        raise Rejected("load_error", why)
    counts = np.array([loop.count(b"vertex") for loop in loops], np.int64)
    numbers = b" ".join(loops).replace(b"vertex", b" ")
    points = parse_numbers(numbers, 3 * int(counts.sum()), np.float64).reshape(-1, 3)
    cut = cut_polygons(points, counts, np.arange(len(points)), Counter())
    unread = {f"statement {rest[0].decode('latin-1')[:24]!r}": 1} if rest else {}
    return FileMesh(mesh=_build_mesh(points[cut.vertices.ravel()]), unread=list_some(unread))
