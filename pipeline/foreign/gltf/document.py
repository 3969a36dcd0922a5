"""`GltfDocument`: a glTF's checked JSON, and the arrays and pictures that its buffers hold."""

import base64
import json
import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.gltf.nodes import (
    INSTANCING,
    TRS,
    PlacedNode,
    check_tree,
    entry,
    extension,
    list_unread_parts,
    num_instances,
    transforms,
)
from pipeline.foreign.limits import ReadLimits
from pipeline.foreign.material_files import MaterialFiles, SourceFolder
from pipeline.foreign.numbers import Malformed, read_count
from storage.errors import Rejected, TrilightError

_DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_PADDING = 3
"""Bytes by which a buffer may be shorter than stated, since exporters count its padding."""
_MOST_REPLACED = 1 << 23
"""Maximum number of values of a sparse accessor, since they are copied."""

Rows = NDArray[np.int64] | slice


@contextmanager
def refuse_malformed(reason: str, subject: str) -> Iterator[None]:
    """Turn Python's errors about a malformed tree into Rejected."""
    try:
        yield
    except Malformed as error:
        raise Rejected(reason, f"{subject} malformed ({error!s:.200})") from error
    except TrilightError:
        raise
    except KeyError as error:
        missing = f"{error.args[0]!r:.40} is missing or unknown"
        raise Rejected(reason, f"{subject} malformed ({missing})") from error
    except (IndexError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise Rejected(reason, f"{subject} malformed: a value is of another kind") from error


@dataclass(frozen=True, kw_only=True, eq=False)
class GltfDocument:
    """The JSON of a glTF file with its buffers and pictures."""

    tree: dict[str, Any]
    """Parsed JSON of the file."""
    binary: memoryview | None
    """Binary chunk of a GLB; None without one."""
    buffers: Mapping[str, bytes]
    """Contents of the files that buffers name, by URI."""
    pictures: MaterialFiles
    """Contents of the files that images name; empty where limits exclude materials."""
    unread: tuple[str, ...]
    """Short sentences on contents of the file that are not read."""
    _embedded: dict[str, bytes] = field(default_factory=dict)

    def values(
        self, index: Any, widths: tuple[int, ...], rows: Rows, *, is_unit: bool | None = None
    ) -> NDArray[np.float64]:
        """Return rows [N, K] of an accessor; integers as fractions where they are normalized.

        Args:
            index: index of the accessor.
            widths: allowed numbers of components K.
            rows: rows to return.
            is_unit: whether integers are fractions; as the accessor states by default.

        Raises:
            Rejected: cut_off, unsupported_accessor, load_error.
        """
        accessor = entry(self.tree, "accessors", index)
        elements = self._elements(index)
        if elements.shape[1] not in widths:
            raise Malformed(f"accessor {index} has {elements.shape[1]} components")
        if not isinstance(rows, slice) and rows.size and rows.max() >= len(elements):
            raise Malformed(f"accessor {index} has {len(elements)} values, one for each vertex")
        result = elements[rows].astype(np.float64)
        if elements.dtype.kind in "ui" and (
            accessor.get("normalized") if is_unit is None else is_unit
        ):
            result = np.maximum(result / np.iinfo(elements.dtype).max, -1)
        return result

    def indices(self, index: Any) -> NDArray[np.int64]:
        """Return an accessor of vertex indices [N]."""
        elements = self._elements(index)
        if elements.shape[1] != 1 or elements.dtype.kind != "u":
            raise Malformed(f"indices are of type {elements.dtype} x {elements.shape[1]}")
        return elements[:, 0].astype(np.int64)

    def instances(self, placed: PlacedNode) -> NDArray[np.float64]:
        """Return the matrices [N, 4, 4] of all instances of a node's mesh."""
        attributes = extension(placed.node, INSTANCING).get("attributes", {})
        if not attributes:
            return placed.to_world[None]
        count = num_instances(self.tree, placed.node)
        components = [np.tile(np.array(default, np.float64), (count, 1)) for _, default in TRS]
        for row, (name, default) in enumerate(TRS):
            if (number := attributes.get(name.upper())) is not None:
                is_unit = name == "rotation" or None
                components[row] = self.values(number, (len(default),), slice(None), is_unit=is_unit)
        return np.einsum("ij,njk->nik", placed.to_world, transforms(*components))

    def picture_bytes(self, image: Mapping[str, Any]) -> bytes:
        """Return the bytes of an image; raises Rejected where its file is missing."""
        if "bufferView" in image:
            return bytes(self._view(image["bufferView"]))
        uri = image["uri"]
        return data_uri_bytes(uri) if is_data_uri(uri) else self.pictures.require(uri)

    def _elements(self, index: Any) -> NDArray:
        """Return the stored values [N, K] of an accessor; zeros without a buffer view."""
        accessor = entry(self.tree, "accessors", index)
        code = accessor["componentType"]
        kind = accessor["type"]
        count = read_count(accessor, "count")
        if code not in _DTYPES or kind not in _WIDTHS:
            raise Rejected("unsupported_accessor", f"values of type {code!r:.20} {kind!r:.20}")
        dtype = np.dtype(_DTYPES[code])
        width = _WIDTHS[kind]
        if "bufferView" in accessor:
            offset = read_count(accessor, "byteOffset", 0)
            values = self._read_strided(accessor["bufferView"], offset, dtype, width, count)
        else:
            values = np.broadcast_to(np.zeros(1, dtype), (count, width))
        return self._replace_sparse(values, accessor["sparse"]) if "sparse" in accessor else values

    def _replace_sparse(self, values: NDArray, sparse: Mapping[str, Any]) -> NDArray:
        """Return a copy of values with those of a sparse accessor replaced."""
        count = read_count(sparse, "count")
        sparse_indices = sparse["indices"]
        sparse_values = sparse["values"]
        dtype = np.dtype(_DTYPES[sparse_indices["componentType"]])
        offsets = [read_count(each, "byteOffset", 0) for each in (sparse_indices, sparse_values)]
        rows = self._read_strided(sparse_indices["bufferView"], offsets[0], dtype, 1, count)[:, 0]
        if count and int(rows.max()) >= len(values):
            raise Malformed(f"a sparse accessor replaces value {rows.max()} of {len(values)}")
        if len(values) > _MOST_REPLACED:
            raise Rejected("too_many_faces", f"a sparse accessor counts {len(values)} items")
        result = values.copy()
        result[rows.astype(np.int64)] = self._read_strided(
            sparse_values["bufferView"], offsets[1], values.dtype, values.shape[1], count
        )
        return result

    def _read_strided(
        self, view: Any, offset: int, dtype: np.dtype[Any], width: int, count: int
    ) -> NDArray:
        data = self._view(view)
        size = dtype.itemsize * width
        step = read_count(entry(self.tree, "bufferViews", view), "byteStride", 0) or size
        if step < size:
            raise Malformed(f"byteStride is {step}; expected at least {size}")
        if count and offset + (count - 1) * step + size > len(data):
            raise Rejected(
                "load_error",
                f"{count} values take {offset + (count - 1) * step + size} bytes; their buffer "
                f"view has {len(data)}",
            )
        return np.ndarray((count, width), dtype, data if count else b"", offset if count else 0,
                          (step, dtype.itemsize))  # fmt: skip

    def _view(self, index: Any) -> memoryview:
        view = entry(self.tree, "bufferViews", index)
        buffer = entry(self.tree, "buffers", view["buffer"])
        uri = buffer.get("uri")
        data = self.binary
        if uri is not None:
            if is_data_uri(uri) and uri not in self._embedded:
                self._embedded[uri] = data_uri_bytes(uri)
            data = memoryview(self._embedded[uri] if is_data_uri(uri) else self.buffers[uri])
        if data is None or len(data) < read_count(buffer, "byteLength") - _PADDING:
            raise Rejected(
                "cut_off",
                f"a buffer is cut off: it states {buffer['byteLength']} bytes and has "
                f"{0 if data is None else len(data)}",
            )
        start = read_count(view, "byteOffset", 0)
        length = read_count(view, "byteLength")
        if start + length > len(data):
            raise Rejected("load_error", f"buffer view {index} goes beyond its buffer")
        return memoryview(data)[start : start + length]


_REASONS = {
    "texture_outside": "external_uri",
    "texture_missing": "missing_file",
    "texture_too_large": "too_large_bytes",
}
"""Reasons of a buffer that is not read, by those of a picture."""


def open_gltf(data: bytes, suffix: str, files: SourceFolder, limits: ReadLimits) -> GltfDocument:
    """Return a glTF with its buffers, and with its pictures where the limits include materials.

    Args:
        data: the file.
        suffix: suffix of its name, `.glb` or `.gltf`.
        files: the folder of the file; no buffer outside of it is read.
        limits: bounds of what is read.

    Raises:
        Rejected: as `read_container`, `check_tree`, and of a buffer external_uri or missing_file.
    """
    tree, binary = read_container(data, suffix)
    with refuse_malformed("load_error", "the glTF tree is"):
        check_tree(tree, limits)
        unread = list_unread_parts(tree)
        uris = [row["uri"] for row in tree.get("buffers", ()) if "uri" in row]
        named = [uri for uri in uris if not is_data_uri(uri)]
    folder = SourceFolder(files.folder, files.folder)
    bytes_left = limits.max_bytes - len(data)
    buffers = folder.read_all(named, bytes_left, is_uri=True)
    for why in buffers.refused.values():
        raise Rejected(_REASONS.get(why.reason, why.reason), f"the buffer {why.message}")
    bytes_left -= sum(map(len, buffers.data.values()))
    images = tree.get("images") if limits.with_materials else ()
    images = images if isinstance(images, list) else ()
    stated = [row.get("uri") for row in images if isinstance(row, dict)]
    external = [uri for uri in stated if isinstance(uri, str) and not is_data_uri(uri)]
    return GltfDocument(
        tree=tree,
        binary=binary,
        buffers=buffers.data,
        pictures=files.read_all(external, bytes_left, is_uri=True),
        unread=unread,
    )


_MAX_JSON_BYTES = 64_000_000
_HEADER = struct.Struct("<4sII")
_CHUNK = struct.Struct("<I4s")
_BASE64 = bytes.maketrans(b"-_", b"+/")
"""Translation from URL-safe base64 to the standard alphabet."""


def read_container(data: bytes, suffix: str) -> tuple[dict[str, Any], memoryview | None]:
    """Return the JSON of a .gltf or .glb, and the binary chunk of the latter.

    Raises:
        Rejected: load_error, cut_off, unsupported_format
            of another version than 2, too_large_bytes.
    """
    text, binary = _chunks(data) if suffix == ".glb" else (data, None)
    if len(text) > _MAX_JSON_BYTES:
        raise Rejected("too_large_bytes", f"{len(text)} bytes of JSON; limit {_MAX_JSON_BYTES}")
    tree = _parse_json(text.rstrip(b"\0 "))
    _check_version(tree)
    return tree, binary


def _chunks(data: bytes) -> tuple[bytes, memoryview | None]:
    if data[:4] != b"glTF":
        raise Rejected("load_error", "the file is no GLB: it does not begin with glTF")
    if len(data) < _HEADER.size:
        raise _cut_off_error(_HEADER.size, len(data))
    _, version, length = _HEADER.unpack_from(data)
    if version != 2:
        raise _version_error(str(version))
    if length > len(data):
        raise _cut_off_error(length, len(data))
    chunks: list[tuple[bytes, memoryview]] = []  # unknown kinds are legal
    start = _HEADER.size
    while start + _CHUNK.size <= length:
        size, kind = _CHUNK.unpack_from(data, start)
        start += _CHUNK.size
        if start + size > length:
            raise _cut_off_error(start + size, length)
        chunks.append((kind, memoryview(data)[start : start + size]))
        start += size
    if not chunks or chunks[0][0] != b"JSON":
        raise Rejected("load_error", "the first chunk of the GLB is no JSON")
    return bytes(chunks[0][1]), next((body for kind, body in chunks[1:] if kind == b"BIN\0"), None)


def _cut_off_error(expected: int, present: int) -> Rejected:
    return Rejected("cut_off", f"the file is cut off: it states {expected} bytes and has {present}")


def _parse_json(text: bytes) -> dict[str, Any]:
    encoding = json.detect_encoding(text)
    try:
        plain = text.decode(encoding)
    except UnicodeDecodeError:  # names that are not UTF-8 change no triangle
        plain = text.decode("latin-1")
    try:
        tree = json.loads(plain)
    except json.JSONDecodeError as error:
        if plain and (error.pos >= len(plain.rstrip()) or error.msg.startswith("Unterminated")):
            raise Rejected("cut_off", "the file is cut off: its JSON ends early") from error
        where = f"line {error.lineno}, column {error.colno}"
        raise Rejected("load_error", f"the glTF JSON is none from {where} on") from error
    except (ValueError, RecursionError) as error:
        message = "the glTF JSON nests too deeply, or has a number of too many digits"
        raise Rejected("load_error", message) from error
    if not isinstance(tree, dict):
        raise Rejected("load_error", "the glTF JSON is not an object")
    return tree


def _check_version(tree: dict[str, Any]) -> None:
    """Refuse a file that needs another version; a later 2.x without `minVersion` is readable."""
    asset = tree.get("asset")
    stated = asset if isinstance(asset, dict) else {}
    least = stated.get("minVersion")
    version = str(stated.get("version", "2.0"))
    if least not in (None, "2.0"):
        raise _version_error(f"{least!s:.20}")
    if version.partition(".")[0] != "2" or isinstance(tree.get("meshes"), dict):
        raise _version_error("1.0" if isinstance(tree.get("meshes"), dict) else f"{version:.20}")


def _version_error(version: str) -> Rejected:
    message = f"the file needs glTF {version}; expected 2.0: export it as that"
    return Rejected("unsupported_format", message)


def data_uri_bytes(uri: str) -> bytes:
    """Return the bytes of a data: URI of any media type; raises Malformed without a comma."""
    head, comma, body = uri.partition(",")
    if not comma:
        raise Malformed(f"the URI {uri!r:.40} has no data")
    plain = unquote_to_bytes(body)
    if not head.lower().endswith(";base64"):
        return plain
    packed = b"".join(plain.split()).translate(_BASE64)
    return base64.b64decode(packed.rstrip(b"=") + b"=" * (-len(packed.rstrip(b"=")) % 4))


def is_data_uri(uri: str) -> bool:
    """Return whether a URI holds its data itself."""
    return uri[:5].lower() == "data:"
