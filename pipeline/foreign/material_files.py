"""The files that the materials of an object name: pictures, and the MTL of an OBJ.

They are read as buffers are: only regular files below the folder that the user gave, within its
bound of bytes, and never from a server. A picture that is missing ends no object, as a buffer does.
"""

import contextlib
import dataclasses
import os
import re
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from pipeline.foreign.mtl import list_pictures
from pipeline.foreign.obj import list_libraries
from pipeline.foreign.ply import list_ply_pictures
from storage.errors import Rejected

READ_MAPS = {"map_kd", "map_ks", "map_pr", "map_pm", "map_ke"}
"""Maps of an MTL whose pictures are read."""
_ENCODINGS = ("cp1252", "cp932", "gbk", "cp1251", "cp437")
"""Those of old programs, in which a name that is not UTF-8 may be meant."""
_LAYOUTS = ("textures", "images", "../textures", "../images", "../materials/textures")
"""Folders where large collections keep pictures that their MTL files name without a folder."""
_WINDOWS_ROOT = re.compile(r"[A-Za-z]:/|/")

ReadFile = Callable[[Path, int], bytes]
"""Reads a regular file of at most so many bytes; raises Rejected."""


@dataclass(frozen=True, kw_only=True)
class MaterialFiles:
    """What is beside an object."""

    data: Mapping[str, bytes] = field(default_factory=dict)
    """Files by the name under which they are asked for."""
    refused: Mapping[str, Rejected] = field(default_factory=dict)
    """Why others are not there, likewise."""
    libraries: tuple[str, ...] = ()
    """Which of both are the MTL files of an OBJ, the first one that has a material deciding."""

    def of(self, name: str) -> bytes:
        """Return a file; raises Rejected where it is not there."""
        if name in self.data:
            return self.data[name]
        raise self.refused.get(
            name, Rejected("texture_missing", f"{name!r:.80} is not beside the object")
        )

    def join(self, others: "MaterialFiles") -> "MaterialFiles":
        """Return these files and others."""
        return MaterialFiles(
            data={**self.data, **others.data},
            refused={**self.refused, **others.refused},
            libraries=self.libraries,
        )


class SourceFolder:
    """Reads the files that one object names, none of them outside of a root."""

    def __init__(self, folder: Path, root: Path, read: ReadFile) -> None:
        """Remember where to look.

        Args:
            folder: names count from here.
            root: nothing outside of it is touched; `folder` itself where that is elsewhere.
            read: reads a file.
        """
        self._folder = folder.resolve()
        root = root.resolve()
        self._root = root if self._folder.is_relative_to(root) else self._folder
        self._read = read

    def read_all(
        self, names: Iterable[str], left: int, *, is_uri: bool = False, beside: Iterable[str] = ()
    ) -> MaterialFiles:
        """Return files by name, within `left` bytes; they may lie in folders `beside`, too."""
        data, refused = dict[str, bytes](), dict[str, Rejected]()
        for name in dict.fromkeys(names):
            try:
                data[name] = self._read(self._find(name, beside, is_uri=is_uri), left)
                left -= len(data[name])
            except Rejected as why:
                code = {"too_large_bytes": "texture_too_large", "missing_file": "texture_missing"}
                message = f"{name!r:.80}: {why.message}"
                refused[name] = Rejected(code.get(why.reason, why.reason), message)
        return MaterialFiles(data=data, refused=refused)

    def _find(self, name: str, beside: Iterable[str], *, is_uri: bool) -> Path:
        """Return the file that a name means, links followed.

        Raises:
            Rejected: texture_outside or missing_file.
        """
        parts = urlsplit(name) if is_uri else None
        plain = unquote(name) if is_uri else name.replace("\\", "/")
        if "\x00" in plain or (parts and (parts.scheme or parts.netloc)):
            raise Rejected("texture_outside", "it lies elsewhere, and is never fetched")
        is_outside = False
        others = (f"{folder}/{plain}" for folder in beside)
        for spelling in (plain, *others, *_list_spellings(plain)):
            with contextlib.suppress(OSError):  # such as a name that is too long
                target = find_in_any_case(self._folder, spelling, self._root)
                is_inside = target.is_relative_to(self._root)
                if is_inside and target.is_file():
                    return target
                is_outside |= spelling == plain and not is_inside
        if is_outside:
            raise Rejected("texture_outside", "it lies outside the folder of the objects")
        raise Rejected("missing_file", "there is no such file")


def _list_spellings(name: str) -> Iterator[str]:
    """Yield what else a name may mean: in another encoding, or on another machine."""
    with contextlib.suppress(UnicodeEncodeError):
        code = name.encode("latin-1")
        yield os.fsdecode(code)
        for encoding in _ENCODINGS if not name.isascii() else ():
            with contextlib.suppress(UnicodeDecodeError):
                yield code.decode(encoding)
    yield unquote(name)
    yield name.partition(" #")[0].rstrip()  # a comment behind it
    last = name.rpartition("/")[2]
    if _WINDOWS_ROOT.match(name):  # a path of the machine on which the file was written
        yield last
    yield from (f"{folder}/{last}" for folder in _LAYOUTS)


def find_in_any_case(folder: Path, name: str, root: Path) -> Path:
    """Return a file below a folder, links followed; its name may differ in case or composition."""
    target = Path(os.path.realpath(folder / name))
    if not target.is_relative_to(root) or target.exists() or name.startswith("/"):
        return target
    place = folder
    for part in Path(name).parts:
        following = place / part
        if part != ".." and place.is_relative_to(root) and not following.exists():
            with contextlib.suppress(OSError):
                alike = [one for one in os.listdir(place) if _fold_name(one) == _fold_name(part)]
                following = place / min(alike, default=part)
        place = Path(os.path.realpath(following))
    return place


def _fold_name(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def gltf_files(tree: Mapping[str, Any], folder: SourceFolder, left: int) -> MaterialFiles:
    """Return the pictures that a glTF names; `left` is the bound of bytes for all together."""
    images = tree.get("images", ())
    uris = [entry.get("uri") for entry in images if isinstance(entry, dict)]
    named = [uri for uri in uris if isinstance(uri, str) and not uri.startswith("data:")]
    return folder.read_all(named, left, is_uri=True)


def obj_files(data: bytes, folder: SourceFolder, left: int) -> MaterialFiles:
    """Return the MTL files of an OBJ and the pictures that those name."""
    libraries = MaterialFiles()
    for name, *several in list_libraries(data):
        files = folder.read_all([name], left)
        if not files.data and several != [name]:
            files = folder.read_all(several, left)
        left -= sum(map(len, files.data.values()))
        libraries = libraries.join(files)
    libraries = dataclasses.replace(libraries, libraries=(*libraries.data, *libraries.refused))
    named = [name for text in libraries.data.values() for name in list_pictures(text, READ_MAPS)]
    beside = {name.replace("\\", "/").rpartition("/")[0] for name in libraries.data} - {""}
    return libraries.join(folder.read_all(named, left, beside=sorted(beside)))


def ply_files(data: bytes, folder: SourceFolder, left: int) -> MaterialFiles:
    """Return the pictures that a PLY names."""
    return folder.read_all(list_ply_pictures(data), left)
