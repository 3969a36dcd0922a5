"""Reading a source: one bounded read of one regular file, and of the buffers that a glTF names.

Everything that is read of an object is read here. The mesh library is given bytes, never a path,
so that no file can make it open another one. USD alone is given paths, which it checks first.
"""

import hashlib
import stat
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.foreign.gltf.document import GltfDocument, open_gltf
from pipeline.foreign.headers import check_header
from pipeline.foreign.limits import ReadLimits
from pipeline.foreign.material_files import MaterialFiles, obj_files
from pipeline.foreign.usd.stage import SUFFIXES as USD_SUFFIXES
from storage.errors import Rejected

if TYPE_CHECKING:
    from pipeline.foreign.usd.object_source import UsdSource

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off", *USD_SUFFIXES)
"""Formats that we read. The suffix decides: a file that lies about it is refused or fails to load,
and is never handed to the loader of another format."""


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
    unread: tuple[str, ...] = ()
    """What the file says and no code reads, as short sentences, each once."""


def needs_child(path: Path) -> bool:
    """Return whether native code reads the file at once, so that only children may."""
    return path.suffix.lower() in USD_SUFFIXES


def read_source(path: Path, limits: ReadLimits) -> SourceFile:
    """Return a source after the checks that need no mesh library.

    Where `needs_child`, it may only run in one.

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
    materials, keep = MaterialFiles(), limits.with_materials
    if suffix in (".glb", ".gltf"):
        gltf = open_gltf(data, suffix, path.parent, limits, _read_regular)
        materials = gltf.pictures
    elif suffix == ".obj" and keep:
        left = limits.max_bytes - len(data)
        materials = obj_files(data, path.parent, left, _read_regular)
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
        unread=() if gltf is None else gltf.unread,
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
