"""Loads the mesh of a scene file: unchanged, or remeshed. It runs in a child process.

A scene file states where each vertex lies, so nothing is centered, welded, repaired or flipped
here: unlike objects for random scenes, a mesh that a scene names stays unchanged.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.cleaning.clean import check_raw, clean, normalize
from pipeline.assets.decimation.decimate import decimate, safe_method
from pipeline.assets.recipe import methods_of
from pipeline.assets.settings import AssetSettings, Profile
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.source_file import load_mesh, read_source
from storage.errors import Rejected


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneMesh:
    """A mesh in the units of its file, +Z up (a glTF is rotated)."""

    mesh: TriangleMesh
    """Triangles with unwelded vertices; some vertices may belong to no triangle."""
    centre: NDArray[np.float64]
    """[3] mean of all vertices of the file."""
    reach: float
    """Distance of the farthest vertex from the center."""
    sha256: str
    """SHA-256 digest of the file, in hex."""
    unread: tuple[str, ...]
    """Short sentences, one for each part of the file that no reader handled."""


def load_scene_mesh(path: Path, settings: AssetSettings, remesh_faces: int | None) -> SceneMesh:
    """Return the mesh of a file.

    Args:
        path: the only file that is opened, with the buffers that a glTF names below its folder.
        settings: limits on bytes and faces.
        remesh_faces: most triangles of a remeshed mesh, or None for the mesh as it is. Remeshing
            is the profile `uniform` of the mesh stage without its quality checks; RenderFormer's
            own remeshing gives other triangles.

    Raises:
        Rejected: reading or `check_raw` failed, or `remesh_failed`.
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


def remesh(raw: TriangleMesh, num_faces: int, profile: Profile = "uniform") -> TriangleMesh:
    """Return the surface with at most `num_faces` triangles, in the units of the file.

    Raises:
        Rejected: "remesh_failed" where no method gives that many.
        TrilightError: `uniform` without pymeshlab.
    """
    used = raw.positions[np.unique(raw.faces)]
    low = used.min(axis=0)
    high = used.max(axis=0)
    unit = clean(normalize(raw))
    if len(unit.faces):
        for method in methods_of(profile):
            try:
                result = decimate(unit, num_faces, safe_method(unit, method))
            except Rejected:
                continue
            if 0 < len(result.faces) <= num_faces:
                positions = result.positions * (high - low).max() + (low + high) / 2
                return TriangleMesh(positions=positions, faces=result.faces)
    raise Rejected("remesh_failed", f"no method gives at most {num_faces} triangles")
