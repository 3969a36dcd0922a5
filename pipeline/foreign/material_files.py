"""The files that the materials of an object name: pictures, and the MTL of an OBJ.

They are read as buffers are: only regular files below the object's folder, within its bound of
bytes, and never from a server. Other than a buffer, a picture that is missing ends no object.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from storage.errors import Rejected

_MTLLIB = re.compile(rb"^[ \t]*mtllib[ \t]+([^\r\n]+)", re.MULTILINE)
_MAP = re.compile(rb"^[ \t]*((?:map_|norm|bump|disp|refl)\w*)[ \t]+([^\r\n]+)", re.MULTILINE)
_READ_MAPS = (b"map_kd", b"map_ks", b"map_pr", b"map_pm", b"map_ke")
_ARGUMENTS = {"-s": 3, "-o": 3, "-t": 3, "-mm": 2}

ReadFile = Callable[[Path, int], bytes]
"""Reads a regular file of at most so many bytes; raises Rejected."""


@dataclass(frozen=True, kw_only=True)
class MaterialFiles:
    """What is beside an object."""

    data: Mapping[str, bytes] = field(default_factory=dict)
    """Files by the name under which they are asked for."""
    refused: Mapping[str, Rejected] = field(default_factory=dict)
    """Why others are not there, likewise."""

    def of(self, name: str) -> bytes:
        """Return a file; raises Rejected where it is not there."""
        if name in self.data:
            return self.data[name]
        raise self.refused.get(
            name, Rejected("texture_missing", f"{name!r:.80} is not beside the object")
        )


def gltf_files(tree: Mapping[str, Any], folder: Path, left: int, read: ReadFile) -> MaterialFiles:
    """Return the pictures that a glTF names; `left` is the bound of bytes for all together."""
    images = tree.get("images", ())
    uris = [entry.get("uri") for entry in images if isinstance(entry, dict)]
    named = [uri for uri in uris if isinstance(uri, str) and not uri.startswith("data:")]
    return _read_all(named, folder, left, read, is_uri=True)


def obj_files(data: bytes, folder: Path, left: int, read: ReadFile) -> MaterialFiles:
    """Return the MTL files of an OBJ and the pictures that those name."""
    libraries = _read_all(libraries_of(data), folder, left, read)
    left -= sum(map(len, libraries.data.values()))
    named = [name for text in libraries.data.values() for name in _maps_of(text)]
    pictures = _read_all(named, folder, left, read)
    return MaterialFiles(
        data={**libraries.data, **pictures.data},
        refused={**libraries.refused, **pictures.refused},
    )


def libraries_of(data: bytes) -> list[str]:
    """Return the MTL files that an OBJ names."""
    return [_text(name).strip() for name in _MTLLIB.findall(data)]


def _maps_of(data: bytes) -> Iterator[str]:
    for key, value in _MAP.findall(data):
        if key.lower() in _READ_MAPS:
            yield map_words(_text(value))[1]


def map_words(text: str) -> tuple[dict[str, list[str]], str]:
    """Return the options of a map in an MTL, and the file that it names."""
    words, options = text.split(), dict[str, list[str]]()
    while words and words[0].startswith("-"):
        name = words.pop(0).lower()
        values: list[str] = []
        for _ in range(_ARGUMENTS.get(name, 1)):
            if words and (len(values) == 0 or _is_number(words[0])):
                values.append(words.pop(0))
        options[name] = values
    return options, " ".join(words)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _text(data: bytes) -> str:
    return data.decode("utf-8", "replace")


def _read_all(
    names: list[str], folder: Path, left: int, read: ReadFile, *, is_uri: bool = False
) -> MaterialFiles:
    data, refused = dict[str, bytes](), dict[str, Rejected]()
    for name in dict.fromkeys(names):
        try:
            data[name] = read(_place(name, folder, is_uri=is_uri), left)
            left -= len(data[name])
        except Rejected as why:
            code = {"too_large_bytes": "texture_too_large", "missing_file": "texture_missing"}
            message = f"{name!r:.80}: {why.message}"
            refused[name] = Rejected(code.get(why.reason, why.reason), message)
    return MaterialFiles(data=data, refused=refused)


def _place(name: str, folder: Path, *, is_uri: bool) -> Path:
    parts = urlsplit(name) if is_uri else None
    plain = unquote(name) if is_uri else name.replace("\\", "/")
    if "\x00" in plain or (parts and (parts.scheme or parts.netloc)):
        raise Rejected("texture_outside", "it lies elsewhere, and is never fetched")
    root = folder.resolve()
    target = (root / plain).resolve()
    if not target.is_relative_to(root):
        raise Rejected("texture_outside", "it lies outside the folder of the object")
    return target
