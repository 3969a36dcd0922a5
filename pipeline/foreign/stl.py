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
_FACET_BEGINS = re.compile(rb"\sfacet\s+normal(?:\s+[-+.\da-z#()]+){3}(?=\s+outer\s|\s*$)")
_LOOP = re.compile(rb"outer\s+loop((?:\s+vertex(?:\s+\S+){3})+)\s+endloop\s")
_AROUND_LOOP = re.compile(rb"facet(?:\s+normal(?:\s+(?!endfacet)\S+){0,3})?\s+endfacet\s")
_ENDS = re.compile(rb"(?m)^([ \t]*)end[ \t]+(?=(?:facet|loop|solid)\b)")
_WORDS = {b"facet", b"outer", b"loop", b"vertex"}
_MOST_INDENT = 4096
"""Bytes that are searched before the word that begins or ends a solid."""


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


def _strip_names(text: bytes) -> tuple[bytes, bool]:
    """Return a text without the lines that begin and end solids, and whether all solids end.

    The name of a solid goes to the end of its line, or to a facet on the same line.
    """
    pieces: list[bytes] = []
    rest_start = 0
    balance = 0
    at = text.find(b"solid")
    while at >= 0:
        start = at - 3 if text[at - 3 : at] == b"end" else at
        before = text[max(start - _MOST_INDENT, 0) : start].rpartition(b"\n")[2].rstrip()
        end = at + len(b"solid")
        if not before or before.endswith(b"endfacet"):
            balance += 1 if start == at else -1
            last = text.find(b"\n", at)
            last = len(text) if last < 0 else last
            facet = _FACET_BEGINS.search(text, at, last)
            pieces.append(text[rest_start:start])
            rest_start = end = facet.start() if facet else last
        at = text.find(b"solid", end)
    return b" ".join([*pieces, text[rest_start:]]), balance == 0


def _read_text(text: bytes) -> FileMesh:
    text, is_closed = _strip_names(_ENDS.sub(rb"\1end", text) + b"\n")
    loops = _LOOP.findall(text)
    rest = _AROUND_LOOP.sub(b" ", _LOOP.sub(b" ", text)).strip(b"\0\x1a \n").split()
    if not is_closed or (rest and b"solid".startswith(rest[-1])):
        raise Rejected(
            "cut_off", "the STL ends within a facet or the word solid, or without endsolid"
        )
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
