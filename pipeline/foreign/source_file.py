"""`read_source`: one bounded read of a regular file, and of the files that it names.

All files of an object are read here. Parsers receive bytes, never a path, so that no file can make
them open another one. USD alone receives paths, which it checks first.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.foreign.gltf.document import GltfDocument, open_gltf
from pipeline.foreign.gltf.primitives import gltf_mesh
from pipeline.foreign.limits import SUFFIXES, USD_SUFFIXES, ReadLimits
from pipeline.foreign.material_files import MaterialFiles, SourceFolder, obj_files, read_regular
from pipeline.foreign.mesh import FileMesh, TriangleMesh
from pipeline.foreign.obj import read_obj
from pipeline.foreign.off import read_off
from pipeline.foreign.ply import check_face_count, list_ply_pictures, read_ply
from pipeline.foreign.stl import count_facets, read_stl
from storage.errors import Rejected

if TYPE_CHECKING:
    from pipeline.foreign.usd.object_source import UsdSource

_READERS: Mapping[str, Callable[[bytes], FileMesh]] = {
    "obj": read_obj,
    "off": read_off,
    "ply": read_ply,
    "stl": read_stl,
}
"""Readers of the formats with one mesh a file."""

_ARCHIVES = {
    b"PK\x03\x04": "zip",
    b"PK\x05\x06": "zip",
    b"\x1f\x8b": "gzip",
    b"BZh": "bzip2",
    b"\xfd7zXZ\x00": "xz",
    b"7z\xbc\xaf\x27\x1c": "7z",
    b"Rar!": "rar",
    b"\x28\xb5\x2f\xfd": "zstandard",
}
"""Names of archives by their first bytes."""


@dataclass(frozen=True, kw_only=True)
class SourceFile:
    """The bytes of a source whose header has been checked."""

    kind: str
    """Suffix without the dot, in lower case."""
    data: bytes
    """Bytes of the file; empty for USD."""
    sha256: str
    """Digest of the file, its buffers sorted by name, and the material files that are kept."""
    materials: MaterialFiles = field(default_factory=MaterialFiles)
    """Files that materials name; empty where limits exclude them, and for USD."""
    usd: "UsdSource | None" = None
    """Contents of a USD file; None for other formats."""
    gltf: GltfDocument | None = None
    """Contents of a glTF; None for other formats."""
    notes: list[str] = field(default_factory=list)
    """Short sentences on contents of the file that are not read; readers append to it."""

    @cached_property
    def contents(self) -> FileMesh:
        """Return the mesh of an OBJ, OFF, PLY or STL; call it in a child process only.

        Raises:
            Rejected: load_error, index_range, header_size_mismatch or cut_off.
        """
        try:
            with np.errstate(all="ignore"):  # of untrusted numbers; the results are checked later
                contents = _READERS[self.kind](self.data)
        except (MemoryError, Rejected):
            raise
        except Exception as error:  # our own errors must not show as such for untrusted files
            reason = f"the .{self.kind} file is malformed ({type(error).__name__})"
            raise Rejected("load_error", reason) from error
        self.notes.extend(contents.unread)
        return contents

    @property
    def is_single(self) -> bool:
        """Return whether the positions are stored in single precision."""
        if self.usd is not None:
            return False
        return self.kind not in _READERS or self.contents.is_single

    @property
    def unread(self) -> tuple[str, ...]:
        """Return sentences on contents of the file that were not read, each once."""
        usd = () if self.usd is None else self.usd.opened.notes
        gltf = () if self.gltf is None else self.gltf.unread
        return tuple(dict.fromkeys((*usd, *gltf, *self.notes)))


def needs_child(path: Path) -> bool:
    """Return whether `read_source` runs native code, which only child processes may."""
    return path.suffix.lower() in USD_SUFFIXES


def read_source(path: Path, limits: ReadLimits, root: Path | None = None) -> SourceFile:
    """Return a source after the checks that need no mesh library.

    Call it in a child process where `needs_child` says so.

    Args:
        path: the file.
        limits: bounds beyond which the source is refused.
        root: folder below which pictures and materials may lie; that of the file by default.

    Raises:
        Rejected: missing_file, unsupported_format, too_large_bytes, archive_refused,
            header_size_mismatch, cut_off, too_many_faces, unsupported_primitive, load_error,
            unsupported_extension, compressed_geometry, skinned_mesh, scene_cycle,
            too_many_instances, external_uri.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise Rejected("unsupported_format", f"suffix {suffix!r}; expected one of {SUFFIXES}")
    data = read_regular(path, limits.max_bytes)
    if needs_child(path):
        from pipeline.foreign.usd.object_source import UsdSource

        usd = UsdSource(path, limits)
        return SourceFile(kind=suffix[1:], data=b"", sha256=usd.sha256, usd=usd)
    _check_start(data, suffix, limits.max_faces)
    gltf: GltfDocument | None = None
    materials = MaterialFiles()
    bytes_left = limits.max_bytes - len(data)
    folder = SourceFolder(path.parent, root or path.parent)
    if suffix in (".glb", ".gltf"):
        gltf = open_gltf(data, suffix, folder, limits)
        materials = gltf.pictures
    elif suffix == ".obj" and limits.with_materials:
        materials = obj_files(data, folder, bytes_left, normal_maps=limits.with_normal_maps)
    elif suffix == ".ply" and limits.with_materials:
        materials = folder.read_all(list_ply_pictures(data), bytes_left)
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


def _check_start(data: bytes, suffix: str, max_faces: int) -> None:
    """Raise Rejected for an archive, and for a header that counts too many faces."""
    for magic, name in _ARCHIVES.items():
        if data.startswith(magic):
            raise Rejected("archive_refused", f"the file is a {name} archive; unpack it first")
    if data[257:262] == b"ustar":
        raise Rejected("archive_refused", "the file is a tar archive; unpack it first")
    if suffix == ".stl":
        count = count_facets(data)
        if count is not None and count > max_faces:
            raise Rejected("too_many_faces", f"{count} faces; expected <= {max_faces}")
    elif suffix == ".ply":
        check_face_count(data, max_faces)


def load_mesh(source: SourceFile) -> TriangleMesh:
    """Return all triangles of a source in its own units, node transforms applied, +Z up.

    glTF defines +Y as up and is rotated. USD states its up axis and its units, and is converted to
    meters. The other formats define neither and stay as they are. The vertices are as the file has
    them: unwelded, some unused, possibly not finite.

    Raises:
        Rejected: load_error, index_range, point_cloud, no_faces, header_size_mismatch, cut_off; of
            glTF also unsupported_accessor; of USD also too_many_faces and offset_precision.
    """
    if source.usd is not None:
        return source.usd.mesh
    if source.gltf is not None:
        return gltf_mesh(source.gltf)
    mesh = source.contents.mesh
    unread = "; ".join(source.contents.unread)
    if len(mesh.faces) == 0:
        reason = "point_cloud" if len(mesh.positions) and not unread else "no_faces"
        raise Rejected(
            reason, "the file holds no triangles" + (f"; not read: {unread}" if unread else "")
        )
    return mesh
