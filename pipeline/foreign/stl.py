"""The mesh of an STL: binary of the length that it counts, or text in which white space is free."""

import re
from collections import Counter

import numpy as np

from pipeline.foreign.mesh import FileMesh, TriangleMesh
from pipeline.foreign.text import list_some, parse_numbers, plain_text, split_lines
from storage.errors import Rejected

_HEADER_BYTES = 84
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_FACET_BEGINS = re.compile(rb"\sfacet\s+normal\s+[-+.\d]")
_WORDS = {
    **{0: b"facet", 1: b"normal", 5: b"outer", 6: b"loop", 7: b"vertex"},
    **{11: b"vertex", 15: b"vertex", 19: b"endloop", 20: b"endfacet"},
}
"""Key words of a facet by their place among its 21 words."""
_NUM_WORDS = 21
_MOST_INDENT = 4096
"""Bytes that are looked at before a solid begins or ends."""


def read_stl(data: bytes) -> FileMesh:
    """Return the triangles of an STL.

    Raises:
        Rejected: load_error, header_size_mismatch or cut_off.
    """
    count = int.from_bytes(data[80:_HEADER_BYTES], "little")
    if len(data) == _HEADER_BYTES + _FACET.itemsize * count:
        return _read_binary(data)
    text = plain_text(data)
    if text.lstrip()[:5].lower() != b"solid" or b"\0" in text[:_HEADER_BYTES]:
        raise Rejected(
            "header_size_mismatch",
            f"the STL header counts {count} facets, which {len(data)} bytes do not hold",
        )
    return _read_text(text.lower())


def _read_binary(data: bytes) -> FileMesh:
    facets = np.frombuffer(data, _FACET, offset=_HEADER_BYTES)
    unread = Counter[str]()
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
    """Return a text without what begins and ends solids, and whether each of them ends.

    The name of a solid goes to the end of its line, or to a facet on the same line.
    """
    pieces, kept, balance, at = list[bytes](), 0, 0, text.find(b"solid")
    while at >= 0:
        start = at - 3 if text[at - 3 : at] == b"end" else at
        before = text[max(start - _MOST_INDENT, 0) : start].rpartition(b"\n")[2].rstrip()
        end = at + len(b"solid")
        if not before or before.endswith(b"endfacet"):
            balance += 1 if start == at else -1
            last = text.find(b"\n", at)
            last = len(text) if last < 0 else last
            facet = _FACET_BEGINS.search(text, at, last)
            pieces.append(text[kept:start])
            kept = end = facet.start() if facet else last
        at = text.find(b"solid", end)
    return b" ".join([*pieces, text[kept:]]), balance == 0


def _read_text(text: bytes) -> FileMesh:
    text, is_closed = _strip_names(text)
    lines = split_lines(text)
    words = lines.words
    if len(words) % _NUM_WORDS or not is_closed:
        raise Rejected("cut_off", "the STL ends within a facet, or without endsolid")
    facets = words.reshape(-1, _NUM_WORDS)
    for column, word in _WORDS.items():
        places = facets[:, column, None] + np.arange(len(word) + 1)
        codes = lines.codes[places]
        if (codes[:, :-1] != np.frombuffer(word, np.uint8)).any() or (codes[:, -1] > 32).any():
            raise Rejected("load_error", f"the STL lacks {word.decode()!r} in a facet")
    begins, ends = facets[:, 7].tolist(), facets[:, 19].tolist()
    loops = b" ".join(lines.text[low:high] for low, high in zip(begins, ends, strict=True))
    numbers = parse_numbers(loops.replace(b"vertex", b" "), 9 * len(facets), np.float64)
    return FileMesh(mesh=_build_mesh(numbers.reshape(-1, 3)))
