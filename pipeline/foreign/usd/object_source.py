"""`UsdSource`: the triangles and materials of a USD object; only child processes make one."""

import hashlib
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

from pipeline.foreign.limits import ReadLimits
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.usd.object_meshes import PlacedMesh, join_meshes, place_meshes
from pipeline.foreign.usd.object_stage import UsdStage, open_stage, read_or_reject
from pipeline.foreign.usd.stage_materials import StageMaterials, read_stage_materials
from storage.errors import Rejected


class UsdSource:
    """The contents of a USD file; materials are read where limits include them."""

    def __init__(self, path: Path, limits: ReadLimits) -> None:
        """Open the file and those that it names.

        Raises:
            Rejected: as `open_stage`, or too_large_bytes for all layers together.
        """
        self._path = path
        self._limits = limits
        self.stage: UsdStage = open_stage(path, limits)
        self._digest, bytes_left = _digest_files(self.stage.opened.files, limits.max_bytes)
        self._materials: StageMaterials | Rejected | None = None
        if limits.with_materials:
            try:
                self._materials = read_or_reject(
                    path, lambda: read_stage_materials(self.stage, bytes_left)
                )
            except Rejected as why:
                self._materials = Rejected(why.reason, why.message)  # its traceback holds the stage

    @property
    def sha256(self) -> str:
        """Return the digest of all layers, the root first, and of the pictures of materials."""
        digest = self._digest.copy()
        if isinstance(self._materials, StageMaterials):
            pictures = self._materials.pictures.data
            for place in sorted(pictures):
                digest.update(pictures[place])
        return digest.hexdigest()

    @property
    def unread(self) -> tuple[str, ...]:
        """Return sentences on contents of the file that are not read, each once."""
        return self.stage.opened.notes

    @cached_property
    def meshes(self) -> tuple[PlacedMesh, ...]:
        """Return the meshes; raises Rejected as `place_meshes`, or load_error."""
        return read_or_reject(self._path, lambda: place_meshes(self.stage, self._limits))

    @cached_property
    def mesh(self) -> TriangleMesh:
        """Return all meshes as one, in meters, +Z up; raises Rejected as `meshes`."""
        return join_meshes(self.meshes)

    def materials(self) -> StageMaterials:
        """Return the materials; raises Rejected as `read_stage_materials`, or no_materials."""
        if isinstance(self._materials, Rejected):
            raise self._materials
        if self._materials is None:
            raise Rejected("no_materials", "materials were not asked for")
        return self._materials


def _digest_files(files: Sequence[Path], bytes_left: int) -> "tuple[hashlib._Hash, int]":
    """Return the digest of files, and the bytes that are left of their bound."""
    digest = hashlib.sha256()
    for path in files:
        data = path.read_bytes()
        if len(data) > bytes_left:
            raise Rejected("too_large_bytes", f"the layers together; {bytes_left} bytes are left")
        digest.update(data)
        bytes_left -= len(data)
    return digest, bytes_left
