"""Reading a source: one bounded read of one regular file, and of the buffers that a glTF names.

Everything that is read of an object is read here. The mesh library is given bytes, never a path,
so that no file can make it open another one. USD alone is given paths, which it checks first.
"""

import hashlib
import stat
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.foreign.gltf.document import GltfDocument, open_gltf
from pipeline.foreign.headers import check_header
from pipeline.foreign.limits import ReadLimits
from pipeline.foreign.material_files import MaterialFiles, SourceFolder, obj_files, ply_files
from pipeline.foreign.mesh import FileMesh
from pipeline.foreign.obj import read_obj
from pipeline.foreign.off import read_off
from pipeline.foreign.ply import read_ply
from pipeline.foreign.stl import read_stl
from pipeline.foreign.usd.stage import SUFFIXES as USD_SUFFIXES
from storage.errors import Rejected

if TYPE_CHECKING:
    from pipeline.foreign.usd.object_source import UsdSource

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off", *USD_SUFFIXES)
"""Formats that we read. The suffix decides: a file that lies about it is refused or fails to load,
and is never handed to the loader of another format."""

_READERS: Mapping[str, Callable[[bytes], FileMesh]] = {
    "obj": read_obj,
    "off": read_off,
    "ply": read_ply,
    "stl": read_stl,
}
"""Readers of formats with one mesh a file."""


@dataclass(frozen=True, kw_only=True)
class SourceFile:
    """The bytes of a source, checked as far as its header goes."""

    kind: str
    """Suffix without the dot, in lower case."""
    data: bytes
    """The file."""
    sha256: str
    """Digest of the file and of its buffers in the order of their names; and of the files of its
    materials, where those are kept."""
    materials: MaterialFiles = field(default_factory=MaterialFiles)
    """Files that its materials name; empty where nobody keeps them. USD has its own."""
    usd: "UsdSource | None" = None
    """What a USD file holds; `data` is empty then."""
    gltf: GltfDocument | None = None
    """What a glTF holds."""
    notes: list[str] = field(default_factory=list)
    """What of the file no code reads, in short sentences; added while it is read."""

    @cached_property
    def contents(self) -> FileMesh:
        """Mesh of an OBJ, OFF, PLY or STL; call in a child alone.

        Raises:
            Rejected: load_error, index_range, header_size_mismatch or cut_off.
        """
        try:
            with np.errstate(all="ignore"):  # numbers of strangers: guards look at the results
                contents = _READERS[self.kind](self.data)
        except (MemoryError, Rejected):
            raise
        except Exception as error:  # no file of a stranger may show a mistake of ours as one
            reason = f"the .{self.kind} file is malformed ({type(error).__name__})"
            raise Rejected("load_error", reason) from error
        self.notes.extend(contents.unread)
        return contents

    @property
    def is_single(self) -> bool:
        """Whether the positions are stored in single precision."""
        if self.usd is not None:
            return False
        return self.kind not in _READERS or self.contents.is_single

    @property
    def unread(self) -> tuple[str, ...]:
        """What of the file no code has read, each sentence once."""
        usd = () if self.usd is None else self.usd.unread
        gltf = () if self.gltf is None else self.gltf.unread
        return tuple(dict.fromkeys((*usd, *gltf, *self.notes)))


def needs_child(path: Path) -> bool:
    """Return whether native code reads the file at once, so that only children may."""
    return path.suffix.lower() in USD_SUFFIXES


def read_source(path: Path, limits: ReadLimits, root: Path | None = None) -> SourceFile:
    """Return a source after the checks that need no mesh library.

    Where `needs_child`, it may only run in one.

    Args:
        path: the file.
        limits: what is refused as too much.
        root: folder below which pictures and materials may lie; the file's own one by default.

    Raises:
        Rejected: missing_file, unsupported_format, too_large_bytes, archive_refused,
            header_size_mismatch, cut_off, too_many_faces, unsupported_primitive, load_error,
            unsupported_extension, compressed_geometry, skinned_mesh, scene_cycle,
            too_many_instances, external_uri.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise Rejected("unsupported_format", f"suffix {suffix!r}; expected one of {SUFFIXES}")
    data = _read_regular(path, limits.max_bytes)
    if needs_child(path):
        return _usd_file(path, limits)
    check_header(data, suffix, limits.max_faces)
    gltf: GltfDocument | None = None
    materials = MaterialFiles()
    keep = limits.with_materials
    folder = SourceFolder(path.parent, root or path.parent, _read_regular)
    if suffix in (".glb", ".gltf"):
        gltf = open_gltf(data, suffix, path.parent, folder, limits, _read_regular)
        materials = gltf.pictures
    elif suffix in (".obj", ".ply") and keep:
        list_files = obj_files if suffix == ".obj" else ply_files
        materials = list_files(data, folder, limits.max_bytes - len(data))
    digest = hashlib.sha256(data)
    buffers = {} if gltf is None else gltf.buffers
    for files in (buffers, materials.data):
        for uri in sorted(files):
            digest.update(files[uri])
    return SourceFile(
        kind=suffix[1:],
        data=data,
        sha256=digest.hexdigest(),
        materials=materials,
        gltf=gltf,
    )


def _usd_file(path: Path, limits: ReadLimits) -> SourceFile:
    from pipeline.foreign.usd.object_source import UsdSource

    usd = UsdSource(path, limits)
    kind = path.suffix.lower()[1:]
    return SourceFile(kind=kind, data=b"", sha256=usd.sha256, usd=usd)


def _read_regular(path: Path, max_bytes: int) -> bytes:
    """Read a file that is one: a pipe or a device would never end."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise Rejected("missing_file", "the path is not a regular file")
        if status.st_size > max_bytes:
            raise Rejected("too_large_bytes", f"{status.st_size} bytes; expected <= {max_bytes}")
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError) as error:
        raise Rejected("missing_file", "there is no such file") from error
