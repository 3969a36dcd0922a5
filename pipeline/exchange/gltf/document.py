"""A glTF file: its checked JSON, and the arrays and pictures that its buffers hold.

The JSON of a stranger is checked first (pipeline.foreign.gltf_tree): compressed, sparse and
quantised geometry, skins and morphed meshes are refused there by name.
"""

import base64
import binascii
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.pictures import MAX_BYTES
from pipeline.foreign.gltf_tree import read_tree
from pipeline.foreign.limits import ReadLimits
from pipeline.foreign.source_file import read_source
from storage.errors import Rejected, TrilightError

_DTYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32,
           5126: np.float32}  # fmt: skip
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class GltfDocument:
    """One file with its buffers."""

    def __init__(self, path: Path) -> None:
        """Read the file and the buffers that it names.

        Raises:
            TrilightError: as `read_source` refuses it.
        """
        self.name = path.name
        self._folder = path.parent.resolve()
        try:
            source = read_source(path, ReadLimits())
            self.tree = read_tree(source.data, f".{source.kind}")
        except Rejected as error:
            raise TrilightError(f"{path.name}: {error}") from error
        self._binary = _binary_chunk(source.data) if source.kind == "glb" else b""
        self._buffers = source.buffers

    def accessor(self, index: int) -> NDArray:
        """Return the values [N, K] of an accessor; normalised integers as floats.

        Raises:
            TrilightError: it goes beyond its buffer, or is sparse.
        """
        stated = self.tree["accessors"][index]
        if "bufferView" not in stated or "sparse" in stated:
            raise TrilightError(f"{self.name}: accessor {index} is sparse or compressed.")
        dtype, width = np.dtype(_DTYPES[stated["componentType"]]), _WIDTHS[stated["type"]]
        count, view = int(stated["count"]), self.tree["bufferViews"][stated["bufferView"]]
        data = self._view_bytes(stated["bufferView"])
        step = int(view.get("byteStride", 0)) or dtype.itemsize * width
        start = int(stated.get("byteOffset", 0))
        if count < 1 or start < 0 or step < dtype.itemsize * width:
            raise TrilightError(f"{self.name}: accessor {index} has no values.")
        if start + (count - 1) * step + dtype.itemsize * width > len(data):
            raise TrilightError(f"{self.name}: accessor {index} goes beyond its buffer.")
        values = np.ndarray((count, width), dtype, data, start, (step, dtype.itemsize)).copy()
        if stated.get("normalized") and dtype.kind in "ui":
            most = 2.0 ** (8 * dtype.itemsize - (dtype.kind == "i")) - 1
            return np.maximum(values / most, -1).astype(np.float32)
        return values

    def picture_bytes(self, index: int) -> bytes | None:
        """Return the bytes of a picture; None where its file is missing.

        Raises:
            TrilightError: its file is outside of the folder, on the network, or too large.
        """
        stated = self.tree["images"][index]
        if "bufferView" in stated:
            return bytes(self._view_bytes(stated["bufferView"]))
        uri = stated.get("uri")
        if not isinstance(uri, str):
            return None
        if uri.startswith("data:"):
            return _embedded(uri)
        return self._file(uri)

    def _file(self, uri: str) -> bytes | None:
        from urllib.parse import unquote, urlsplit

        parts = urlsplit(uri)
        target = (self._folder / unquote(uri)).resolve() if "\0" not in unquote(uri) else None
        if parts.scheme or parts.netloc or target is None:
            raise TrilightError(f"{self.name}: names {uri!r:.80}; expected a file of its folder.")
        if not target.is_relative_to(self._folder):
            raise TrilightError(f"{self.name}: names {uri!r:.80}, which is outside of its folder.")
        if not target.is_file():
            return None
        if target.stat().st_size > MAX_BYTES:
            raise TrilightError(f"{target.name}: expected at most {MAX_BYTES} bytes.")
        return target.read_bytes()

    def _view_bytes(self, index: int) -> memoryview:
        view = self.tree["bufferViews"][index]
        buffer = self.tree["buffers"][view["buffer"]]
        uri = buffer.get("uri")
        if uri is None:
            data = self._binary
        else:
            data = _embedded(uri) if uri.startswith("data:") else self._buffers[uri]
        start, length = int(view.get("byteOffset", 0)), int(view["byteLength"])
        if start < 0 or length < 0 or start + length > len(data):
            raise TrilightError(f"{self.name}: buffer view {index} goes beyond its buffer.")
        return memoryview(data)[start : start + length]


def _binary_chunk(data: bytes) -> bytes:
    start = 20 + int.from_bytes(data[12:16], "little")
    if data[start + 4 : start + 8] != b"BIN\0":
        return b""
    return data[start + 8 : start + 8 + int.from_bytes(data[start : start + 4], "little")]


def _embedded(uri: str) -> bytes:
    """Return the bytes of a `data:` URI; empty where they are damaged."""
    try:
        return base64.b64decode(uri.partition(",")[2], validate=False)
    except (binascii.Error, ValueError):
        return b""


def extension(entry: Any, name: str) -> dict[str, Any]:
    """Return an extension of an entry; empty where it has none."""
    found = entry.get("extensions", {}).get(name, {})
    return found if isinstance(found, dict) else {}
