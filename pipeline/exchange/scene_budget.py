"""Reduces the triangles of a user's scene: each object gives up the same share.

Emitters stay as they are. What becomes of an object is what the mesh stage makes of it; a triangle
takes the material of the nearest old one, and normals are made anew where they were smooth.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.cleaning.clean import clean, normalise
from pipeline.assets.decimation.by_name import decimate, safe_method
from pipeline.assets.recipe import methods_of
from pipeline.foreign.mesh import TriangleMesh
from pipeline.scenes.pieces import ScenePiece, concatenate_pieces
from pipeline.scenes.posing import without_slivers
from pipeline.scenes.shading import ShadedMesh, face_normals, flat_shaded, smooth_shaded
from storage.errors import Rejected, TrilightError
from storage.records.retextured import without_maps
from storage.records.scene import Scene

LEAST = 4
"""Fewest triangles that an object is brought down to."""

_LOST = "textures became their means: reduced triangles have no texture coordinates"
_SMOOTH_ANGLE_DEG = 30.0
_FLAT = 1e-3


def within_budget(scene: Scene, budget: int) -> tuple[Scene, tuple[str, ...]]:
    """Return the scene with at most `budget` triangles, and what that cost, for people.

    Raises:
        TrilightError: emitters alone are more, or an object cannot be reduced that far.
    """
    lost = [_LOST] if scene.textures else []
    scene = without_maps(scene, environment=False)
    counts = np.bincount(scene.object_index, minlength=len(scene.objects))
    emits = np.array([entry.kind == "emitter" for entry in scene.objects])
    room = budget - int(counts[emits].sum())
    least = np.where(emits, 0, np.minimum(counts, LEAST))
    more = np.where(emits, 0, counts) - least
    share = max(room - int(least.sum()), 0) / max(int(more.sum()), 1)
    pieces = []
    for row in np.flatnonzero(counts):
        piece = _piece_of(scene, int(row))
        if not emits[row]:
            piece = _reduced(piece, int(least[row] + more[row] * share))
        pieces.append(piece)
    total = sum(len(piece.mesh.faces) for piece in pieces)
    if total > budget:
        raise TrilightError(
            f"--budget is {budget}; expected at least {total}, the fewest triangles of this scene "
            f"(emitters take {counts[emits].sum()} of them)."
        )
    reduced = Scene(
        **concatenate_pieces(pieces),
        c2w=scene.c2w,
        fov_deg=scene.fov_deg,
        objects=tuple(piece.entry for piece in pieces),
        provenance={**scene.provenance, "budget": budget},
        environment=scene.environment,
    )
    reduced.check()
    return reduced, (f"{scene.num_triangles} triangles reduced to {total}", *lost)


def _piece_of(scene: Scene, row: int) -> ScenePiece:
    own = scene.object_index == row
    rows, corners = np.unique(scene.faces[own], return_inverse=True)
    palette, index = np.unique(scene.material_index[own], return_inverse=True)
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


def _reduced(piece: ScenePiece, count: int) -> ScenePiece:
    from scipy.spatial import cKDTree

    old = piece.mesh
    if len(old.faces) <= count:
        return piece
    positions, faces = _simpler(piece, count)
    faces = without_slivers(positions, faces)
    own = face_normals(old.positions, old.faces)[:, None]
    smooth = bool((np.abs(old.normals[old.faces] - own) > _FLAT).any())
    mesh = (
        smooth_shaded(positions, faces, _SMOOTH_ANGLE_DEG)
        if smooth
        else flat_shaded(positions, faces)
    )
    centres = old.positions[old.faces].mean(axis=1)
    _, nearest = cKDTree(centres).query(mesh.positions[mesh.faces].mean(axis=1))
    return ScenePiece(
        entry=piece.entry,
        mesh=mesh,
        materials=piece.materials,
        material_index=piece.material_index[nearest],
    )


def _simpler(piece: ScenePiece, count: int) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    raw = TriangleMesh(
        positions=piece.mesh.positions.astype(np.float64), faces=piece.mesh.faces.astype(np.int64)
    )
    low, high = raw.positions.min(axis=0), raw.positions.max(axis=0)
    unit = clean(normalise(raw))
    for method in methods_of("faithful"):
        try:
            found = decimate(unit, count, safe_method(unit, method))
        except Rejected:
            continue
        if 0 < len(found.faces) <= count:
            positions = found.positions * (high - low).max() + (low + high) / 2
            return positions.astype(np.float32), found.faces.astype(np.uint32)
    raise TrilightError(
        f"{piece.entry.name}: no method gives at most {count} of its {len(raw.faces)} triangles; "
        "choose a larger --budget."
    )
