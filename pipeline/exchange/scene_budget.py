"""Reduces the triangles of a user's scene, by the same fraction in each object.

Emitters stay unchanged. The mesh stage's decimation reduces an object; each new triangle takes the
material of the nearest old one, and smooth normals are computed again.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.mesh import TriangleMesh
from pipeline.scenes.pieces import ScenePiece, concatenate_pieces
from pipeline.scenes.shading_normals import (
    ShadedMesh,
    face_normals,
    flat_shaded,
    has_area,
    smooth_shaded,
)
from storage.errors import Rejected, TrilightError
from storage.records.retextured import without_maps
from storage.records.scene import Scene

LEAST = 4
"""Minimum number of triangles of a reduced object."""

_LOST = "textures became their means: reduced triangles have no texture coordinates"
_SMOOTH_ANGLE_DEG = 30.0
_FLAT = 1e-3


def within_budget(scene: Scene, budget: int) -> tuple[Scene, tuple[str, ...]]:
    """Return the scene with at most `budget` triangles, and notes on what that cost.

    Raises:
        TrilightError: emitters alone exceed the budget, or an object cannot be reduced that far.
    """
    lost = [_LOST] if scene.textures else []
    scene = without_maps(scene, environment=False)
    counts = np.bincount(scene.object_index, minlength=len(scene.objects))
    emits = np.array([entry.kind == "emitter" for entry in scene.objects])
    room = budget - int(counts[emits].sum())
    least = np.where(emits, 0, np.minimum(counts, LEAST))
    more = np.where(emits, 0, counts) - least
    fraction = max(room - int(least.sum()), 0) / max(int(more.sum()), 1)
    pieces = []
    for row in np.flatnonzero(counts):
        piece = _build_piece(scene, int(row))
        if not emits[row]:
            piece = _reduce_piece(piece, int(least[row] + more[row] * fraction))
        pieces.append(piece)
    total = sum(len(piece.mesh.faces) for piece in pieces)
    if total > budget:
        raise TrilightError(
            f"--budget is {budget}; expected at least {total}, the fewest triangles of this scene "
            f"(emitters take {counts[emits].sum()} of them)."
        )
    reduced = dataclasses.replace(
        scene,
        **concatenate_pieces(pieces),
        objects=tuple(piece.entry for piece in pieces),
        provenance={**scene.provenance, "budget": budget},
    )
    reduced.check()
    return reduced, (f"{scene.num_triangles} triangles reduced to {total}", *lost)


def _build_piece(scene: Scene, row: int) -> ScenePiece:
    in_object = scene.object_index == row
    rows, corners = np.unique(scene.faces[in_object], return_inverse=True)
    palette, index = np.unique(scene.material_index[in_object], return_inverse=True)
    faces = corners.reshape(-1, 3).astype(np.uint32)
    return ScenePiece(
        entry=scene.objects[row],
        mesh=ShadedMesh(
            positions=scene.vertex_positions[rows],
            normals=scene.vertex_normals[rows],
            faces=faces,
            groups=np.zeros(len(faces), np.int64),
        ),
        materials=scene.materials[palette],
        material_index=index.astype(np.int64),
    )


def _reduce_piece(piece: ScenePiece, count: int) -> ScenePiece:
    from scipy.spatial import cKDTree

    old = piece.mesh
    if len(old.faces) <= count:
        return piece
    positions, faces = _decimate_mesh(piece, count)
    faces = faces[has_area(positions, faces)]
    flat = face_normals(old.positions, old.faces)[:, None]
    smooth = bool((np.abs(old.normals[old.faces] - flat) > _FLAT).any())
    mesh = (
        smooth_shaded(positions, faces, _SMOOTH_ANGLE_DEG)
        if smooth
        else flat_shaded(positions, faces)
    )
    centers = old.positions[old.faces].mean(axis=1)
    _, nearest = cKDTree(centers).query(mesh.positions[mesh.faces].mean(axis=1))
    return dataclasses.replace(piece, mesh=mesh, material_index=piece.material_index[nearest])


def _decimate_mesh(piece: ScenePiece, count: int) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    from pipeline.assets.scene_mesh import remesh  # loads mesh libraries

    faces = piece.mesh.faces.astype(np.int64)
    raw = TriangleMesh(positions=piece.mesh.positions.astype(np.float64), faces=faces)
    try:
        reduced = remesh(raw, count, "faithful")
    except Rejected as rejection:
        raise TrilightError(
            f"{piece.entry.name}: no method gives at most {count} of its {len(faces)} triangles; "
            "choose a larger --budget."
        ) from rejection
    return reduced.positions.astype(np.float32), reduced.faces.astype(np.uint32)
