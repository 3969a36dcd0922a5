"""The mesh of a scene file: as it is, or with even triangles. It runs in a child process.

A scene file says where each vertex goes, so nothing is centred, joined, repaired or turned around
here: other than objects for random scenes, a mesh that is named by a scene stays what it is.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.cleaning.clean import clean, normalise
from pipeline.assets.cleaning.guards import check_raw
from pipeline.assets.decimation.by_name import decimate, safe_method
from pipeline.assets.recipe import methods_of
from pipeline.assets.settings import AssetSettings
from pipeline.foreign.load import load_mesh
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.source_file import read_source
from storage.errors import Rejected


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneMesh:
    """A mesh in the units of its file, +Z up (a glTF is turned)."""

    mesh: TriangleMesh
    """Its triangles; the vertices unwelded, possibly some without a triangle."""
    centre: NDArray[np.float64]
    """[3] mean of all vertices of the file."""
    reach: float
    """Distance of the farthest of them from the centre."""
    sha256: str
    """Digest of the file."""
    unread: tuple[str, ...]
    """What of the file no code has read, in short sentences."""


def load_scene_mesh(path: Path, settings: AssetSettings, remesh_faces: int | None) -> SceneMesh:
    """Return the mesh of a file.

    Args:
        path: the only file that is opened, with the buffers that a glTF names below its folder.
        settings: limits on bytes and faces.
        remesh_faces: most triangles of a remeshed mesh, or None for the mesh as it is. Remeshing
            is the profile `uniform` of the mesh stage without its gate; the published one gives
            other triangles.

    Raises:
        Rejected: the reason codes of reading, of `check_raw`, and `remesh_failed`.
        TrilightError: remeshing without pymeshlab.
    """
    source = read_source(path, settings.read_limits)
    raw = load_mesh(source)
    check_raw(raw, settings, is_single=source.is_single)
    if not np.isfinite(raw.positions).all():
        raise Rejected("nonfinite_vertices", "a vertex without a triangle is not finite")
    centre = raw.positions.mean(axis=0)
    reach = float(np.sqrt(np.sum(np.square(raw.positions - centre), axis=1).max()))
    mesh = raw if remesh_faces is None else remesh(raw, remesh_faces)
    return SceneMesh(
        mesh=mesh,
        centre=centre,
        reach=reach,
        sha256=source.sha256,
        unread=source.unread,
    )


def remesh(raw: TriangleMesh, num_faces: int) -> TriangleMesh:
    """Return the surface with at most `num_faces` triangles of even size, where the file has it.

    Raises:
        Rejected: "remesh_failed" where no method gives that.
        TrilightError: pymeshlab is not installed.
    """
    used = raw.positions[np.unique(raw.faces)]
    low = used.min(axis=0)
    high = used.max(axis=0)
    unit = clean(normalise(raw))
    if len(unit.faces):
        for method in methods_of("uniform"):
            try:
                result = decimate(unit, num_faces, safe_method(unit, method))
            except Rejected:
                continue
            if 0 < len(result.faces) <= num_faces:
                positions = result.positions * (high - low).max() + (low + high) / 2
                return TriangleMesh(positions=positions, faces=result.faces)
    raise Rejected("remesh_failed", f"no method gives at most {num_faces} triangles")
