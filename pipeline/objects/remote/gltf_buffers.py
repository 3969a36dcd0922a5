"""Which other files a glTF needs: so that they are fetched with it."""

import json
import posixpath
from pathlib import Path
from urllib.parse import unquote, urlsplit

_MAX_JSON_BYTES = 64_000_000


def buffer_names(path: Path, name: str) -> list[str]:
    """Return the files that the buffers of a `.gltf` name, each once, in their order.

    Whatever is not a relative URI to below the folder of the file is left out, and so is everything
    of a file that is not a glTF: the mesh stage reads it again, and says what is wrong.

    Args:
        path: the file on this machine.
        name: its path below the remote folder; the results are such paths too.
    """
    try:
        if path.stat().st_size > _MAX_JSON_BYTES:
            return []
        tree = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return []
    buffers = tree.get("buffers") if isinstance(tree, dict) else None
    folder = posixpath.dirname(name)
    found: dict[str, None] = {}
    for buffer in buffers if isinstance(buffers, list) else ():
        uri = buffer.get("uri") if isinstance(buffer, dict) else None
        inner = _inner(uri) if isinstance(uri, str) else None
        if inner is not None:
            found[posixpath.join(folder, inner)] = None
    return list(found)


def _inner(uri: str) -> str | None:
    """Return the path that a relative URI names below its folder, or None."""
    try:
        parts = urlsplit(uri)
    except ValueError:
        return None
    inner = posixpath.normpath(unquote(uri))
    if parts.scheme or parts.netloc or not uri or "\x00" in inner or "\n" in inner:
        return None
    if inner.startswith("/") or inner in (".", "..") or inner.startswith("../"):
        return None
    return inner
