"""The files that the materials of an object name: pictures, and the MTL of an OBJ with its parser.

Only regular files below the folder that the user gave are read, within its bound of bytes, and
never from a server. A missing picture does not refuse the object; a missing buffer does.
"""

import contextlib
import dataclasses
import os
import re
import stat
import unicodedata
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote, urlsplit

from pipeline.foreign.obj import list_libraries
from pipeline.foreign.text import decode_name, join_continued, plain_text, unquote_name
from storage.errors import Rejected

READ_MAPS = {"map_kd", "map_ks", "map_pr", "map_pm", "map_ke"}
"""Maps of an MTL whose pictures are read."""
NORMAL_MAPS = {"norm", "map_kn"}
"""Normal maps of an MTL, whose pictures are read on request."""
_ENCODINGS = ("cp1252", "cp932", "gbk", "cp1251", "cp437")
"""Encodings of old programs, tried for names that are not UTF-8."""
_LAYOUTS = ("textures", "images", "../textures", "../images", "../materials/textures")
"""Folders where large collections keep pictures that their MTL files name without a folder."""
_WINDOWS_ROOT = re.compile(r"[A-Za-z]:/|/")

Fields = dict[str, str]
"""Statements of a material, by key words in lower case."""

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?=\s)"
_OPTION = re.compile(
    rf"(-o|-s|-t)((?:\s+{_NUMBER}){{1,3}})\s+|(-mm)((?:\s+{_NUMBER}){{1,2}})\s+|(-[a-z]+)\s+(\S+)\s+",
    re.IGNORECASE,
)


@dataclass(frozen=True, kw_only=True)
class MaterialFiles:
    """Contents of the files that the materials of an object name."""

    data: Mapping[str, bytes] = field(default_factory=dict)
    """Contents of files by the names that materials use."""
    refused: Mapping[str, Rejected] = field(default_factory=dict)
    """Reason of each file that could not be read, by the same names."""
    libraries: tuple[str, ...] = ()
    """Names of the MTL files of an OBJ, read or refused; the first that has a material counts."""

    def require(self, name: str) -> bytes:
        """Return a file; raises Rejected where it is not there."""
        if name in self.data:
            return self.data[name]
        raise self.refused.get(
            name, Rejected("texture_missing", f"{name!r:.80} is not beside the object")
        )

    def join(self, other: "MaterialFiles") -> "MaterialFiles":
        """Return the union of both; libraries stay those of the first."""
        return MaterialFiles(
            data={**self.data, **other.data},
            refused={**self.refused, **other.refused},
            libraries=self.libraries,
        )


class SourceFolder:
    """Reads the files that an object names, none of them outside of a root folder."""

    def __init__(self, folder: Path, root: Path) -> None:
        """Resolve both folders.

        Args:
            folder: relative names start here.
            root: no file outside of it is read; `folder` itself where that lies elsewhere.
        """
        self.folder = folder.resolve()
        root = root.resolve()
        self._root = root if self.folder.is_relative_to(root) else self.folder

    def read_all(
        self,
        names: Iterable[str],
        bytes_left: int,
        *,
        is_uri: bool = False,
        extra_folders: Iterable[str] = (),
    ) -> MaterialFiles:
        """Return files by name, at most `bytes_left` in all; `extra_folders` are searched, too."""
        data: dict[str, bytes] = {}
        refused: dict[str, Rejected] = {}
        for name in dict.fromkeys(names):
            try:
                data[name] = read_regular(
                    self._find(name, extra_folders, is_uri=is_uri), bytes_left
                )
                bytes_left -= len(data[name])
            except Rejected as error:
                code = {"too_large_bytes": "texture_too_large", "missing_file": "texture_missing"}
                message = f"{name!r:.80}: {error.message}"
                refused[name] = Rejected(code.get(error.reason, error.reason), message)
        return MaterialFiles(data=data, refused=refused)

    def _find(self, name: str, extra_folders: Iterable[str], *, is_uri: bool) -> Path:
        """Return the file that a name denotes, links followed.

        Raises:
            Rejected: texture_outside or missing_file.
        """
        plain = unquote(name) if is_uri else name.replace("\\", "/")
        stated = (plain, name, plain.replace("\\", "/")) if is_uri else (plain,)
        if "\x00" in plain or (is_uri and is_elsewhere(name)):
            raise Rejected("texture_outside", "it lies elsewhere, and is never fetched")
        is_outside = False
        extra_spellings = (f"{folder}/{plain}" for folder in extra_folders)
        for spelling in (*stated, *extra_spellings, *_list_spellings(plain)):
            with contextlib.suppress(OSError, ValueError):  # too long, or no name of a file
                target = find_in_any_case(self.folder, spelling, self._root)
                is_inside = target.is_relative_to(self._root)
                if is_inside and target.is_file():
                    return target
                is_outside |= spelling in stated and not is_inside
        if is_outside:
            raise Rejected("texture_outside", "it lies outside the folder of the objects")
        raise Rejected("missing_file", "there is no such file")


def read_regular(path: Path, max_bytes: int) -> bytes:
    """Return the bytes of a regular file, since a pipe or a device would never end.

    Raises:
        Rejected: missing_file or too_large_bytes.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise Rejected("missing_file", f"{path.name!r} is not a regular file")
        if status.st_size > max_bytes:
            raise Rejected("too_large_bytes", f"{status.st_size} bytes; expected <= {max_bytes}")
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError) as error:
        raise Rejected("missing_file", f"there is no file {path.name!r}") from error


def is_elsewhere(uri: str) -> bool:
    """Return whether a URI leads to another machine or folder tree, or is no URI."""
    try:
        parts = urlsplit(uri)
    except ValueError:
        return True
    return bool(parts.scheme or parts.netloc)


def _list_spellings(name: str) -> Iterator[str]:
    """Yield other readings of a name: in another encoding, or as a path of another machine."""
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
    path = folder
    for part in Path(name).parts:
        next_path = path / part
        if part != ".." and path.is_relative_to(root) and not next_path.exists():
            with contextlib.suppress(OSError):
                alike = [one for one in os.listdir(path) if _fold_name(one) == _fold_name(part)]
                next_path = path / min(alike, default=part)
        path = Path(os.path.realpath(next_path))
    return path


def _fold_name(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def obj_files(
    data: bytes, folder: SourceFolder, bytes_left: int, *, normal_maps: bool = False
) -> MaterialFiles:
    """Return the MTL files of an OBJ and the pictures that those name, normal maps on request."""
    libraries = MaterialFiles()
    for name, *several in list_libraries(data):
        files = folder.read_all([name], bytes_left)
        if not files.data and several != [name]:
            files = folder.read_all(several, bytes_left)
        bytes_left -= sum(map(len, files.data.values()))
        libraries = libraries.join(files)
    libraries = dataclasses.replace(libraries, libraries=(*libraries.data, *libraries.refused))
    keys = READ_MAPS | NORMAL_MAPS if normal_maps else READ_MAPS
    materials = [fields for text in libraries.data.values() for fields in read_mtl(text).values()]
    named = [split_map(each[key])[1] for each in materials for key in each if key in keys]
    extra_folders = {name.replace("\\", "/").rpartition("/")[0] for name in libraries.data} - {""}
    return libraries.join(folder.read_all(named, bytes_left, extra_folders=sorted(extra_folders)))


def read_mtl(data: bytes) -> dict[str, Fields]:
    """Return the materials of a library by name; statements before the first one are ignored."""
    materials: dict[str, Fields] = {}
    fields: Fields = {}
    for line in join_continued(plain_text(data)).split(b"\n"):
        words = line.split(maxsplit=1)
        if not words or words[0].startswith(b"#"):
            continue
        key = decode_name(words[0]).lower()
        value = decode_name(b"".join(words[1:]))
        if key == "newmtl":
            fields = materials[unquote_name(value)] = {}
        elif value or not key.startswith("map_"):  # exporters write maps without a file
            fields[key] = value
    return materials


def split_map(text: str) -> tuple[Mapping[str, list[str]], str]:
    """Return the options of a map, in lower case, and the file that it names."""
    options: dict[str, list[str]] = {}
    while option := _OPTION.match(text):
        name, value = [group for group in option.groups() if group is not None]
        options[name.lower()] = value.split()
        text = text[option.end() :]
    return options, unquote_name(text.strip())
