"""The JSON and the binary chunk of a glTF, and the data of its URIs."""

import base64
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote_to_bytes, urlsplit

from pipeline.foreign.material_files import find_in_any_case
from pipeline.foreign.numbers import Malformed
from storage.errors import Rejected

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
    chunks = list(_split(memoryview(data)[:length]))
    if not chunks or chunks[0][0] != b"JSON":
        raise Rejected("load_error", "the first chunk of the GLB is no JSON")
    return bytes(chunks[0][1]), next((body for kind, body in chunks[1:] if kind == b"BIN\0"), None)


def _split(data: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    """Yield kind and bytes of each chunk; unknown kinds are legal."""
    start = _HEADER.size
    while start + _CHUNK.size <= len(data):
        size, kind = _CHUNK.unpack_from(data, start)
        start += _CHUNK.size
        if start + size > len(data):
            raise _cut_off_error(start + size, len(data))
        yield kind, data[start : start + size]
        start += size


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


def local_path(uri: str, folder: Path) -> Path:
    """Return the file below a folder that a relative URI names, percent-encoded or not.

    Raises:
        Rejected: external_uri or missing_file.
    """
    root = folder.resolve()
    try:
        plain = unquote_to_bytes(uri).decode("utf-8", "replace")
        parts = urlsplit(uri)
    except ValueError:
        plain = "\0"
        parts = urlsplit("")
    if "\0" in plain or parts.scheme or parts.netloc:
        raise Rejected("external_uri", f"{uri[:80]!r} lies elsewhere, not in the file's folder")
    targets = [(root / name).resolve() for name in (plain, uri, plain.replace("\\", "/"))]
    if not all(target.is_relative_to(root) for target in targets):
        raise Rejected("external_uri", f"{uri[:80]!r} lies outside of the file's folder")
    if target := next((target for target in targets if target.is_file()), None):
        return target
    target = find_in_any_case(root, plain, root)
    if target.is_relative_to(root) and target.is_file():
        return target
    raise Rejected("missing_file", f"the buffer {uri[:80]!r} is not beside the file")
