"""Subdivides meshes: halves the longest edges until a scene has a given number of triangles.

A test set uses it to measure the effect of the number of triangles alone. Triangles are flat, so
new vertices stay on the surface up to the rounding of float32; each new triangle keeps its
material, and new vertices get the mean of their neighbors' normals.
"""

import dataclasses
import heapq
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.scenes.pieces import ScenePiece
from pipeline.scenes.shading_normals import ShadedMesh

Edge = tuple[int, int]


def fill_triangles(pieces: Sequence[ScenePiece], fill_to: int) -> list[ScenePiece]:
    """Return the pieces with the objects subdivided until the scene has `fill_to` triangles.

    Objects grow in proportion to their triangles. The sum falls short of `fill_to` by a few; pieces
    with more triangles than that stay as they are.
    """
    counts = [len(piece.mesh.faces) for piece in pieces]
    is_object = [piece.entry.kind == "object" for piece in pieces]
    of_objects = sum(count for count, yes in zip(counts, is_object, strict=True) if yes)
    remaining = fill_to - (sum(counts) - of_objects)
    return [
        subdivide(piece, remaining * count // of_objects) if yes else piece
        for piece, count, yes in zip(pieces, counts, is_object, strict=True)
    ]


def subdivide(piece: ScenePiece, num_faces: int) -> ScenePiece:
    """Return a piece with at most `num_faces` faces, short of it by less than one edge's faces.

    The longest edge is halved in every face that has it, so that no gap opens. A piece that has as
    many faces already is returned as it is.
    """
    work = _Work(piece.mesh)
    while work.halve_longest(num_faces):
        pass
    mesh = work.mesh()
    origin = np.array(work.origin)
    skin = piece.skin
    if skin is not None:
        corner_uv = skin.uv.reshape(-1, 3, 2)
        uv = _interpolate_uv(piece.mesh, mesh, origin, corner_uv).astype(np.float32)
        skin = dataclasses.replace(skin, uv=uv.reshape(-1, 2))
    return dataclasses.replace(
        piece, mesh=mesh, material_index=piece.material_index[origin], skin=skin
    )


def _interpolate_uv(
    before: ShadedMesh, after: ShadedMesh, origin: NDArray[np.int64], uv: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Return uv [T, 3, 2] of subdivided triangles, interpolated from `uv` [F, 3, 2]."""
    triangles = before.positions[before.faces].astype(np.float64)[origin]
    parts = after.positions[after.faces].astype(np.float64)
    sides = triangles[:, 1:] - triangles[:, :1]  # [T, 2, 3]
    steps = np.einsum("tpx,tsx->tps", parts - triangles[:, :1], sides)
    gram = np.einsum("tax,tbx->tab", sides, sides)
    across = np.linalg.solve(gram, steps.transpose(0, 2, 1)).transpose(0, 2, 1)  # [T, 3, 2]
    weights = np.concatenate([1 - across.sum(axis=2, keepdims=True), across], axis=2)
    return np.einsum("tpc,tcu->tpu", np.clip(weights, 0, 1), uv[origin].astype(np.float64))


class _Work:
    """A mesh while it is subdivided. Positions identify edges: flat faces share no vertices."""

    def __init__(self, mesh: ShadedMesh) -> None:
        self._points = list(mesh.positions.astype(np.float64))
        self._normals = list(mesh.normals.astype(np.float64))
        _, ids = np.unique(mesh.positions, axis=0, return_inverse=True)
        self._position_ids: list[int] = ids.ravel().tolist()
        self._num_positions = 1 + max(self._position_ids)
        self._groups = mesh.groups
        self._faces: list[list[int]] = mesh.faces.tolist()
        self.origin = list(range(len(self._faces)))
        self._rows: dict[Edge, set[int]] = {}
        self._longest: list[tuple[float, Edge]] = []
        for row in range(len(self._faces)):
            self._enter(row)

    def mesh(self) -> ShadedMesh:
        normals = np.array(self._normals)
        normals /= np.sqrt(np.sum(np.square(normals), axis=1, keepdims=True))
        return ShadedMesh(
            positions=np.array(self._points, np.float32),
            normals=normals.astype(np.float32),
            faces=np.array(self._faces, np.uint32),
            groups=self._groups[np.array(self.origin)],
        )

    def halve_longest(self, num_faces: int) -> bool:
        """Halve the longest edge, if its faces leave the mesh within `num_faces`."""
        while not self._rows[self._longest[0][1]]:
            del self._rows[heapq.heappop(self._longest)[1]]
        edge = self._longest[0][1]
        if len(self._faces) + len(self._rows[edge]) > num_faces:
            return False
        heapq.heappop(self._longest)
        middle = self._num_positions
        self._num_positions = self._num_positions + 1
        made: dict[Edge, int] = {}
        for row in sorted(self._rows.pop(edge)):
            self._halve(row, edge, middle, made)
        return True

    def _halve(self, row: int, edge: Edge, position_id: int, made: dict[Edge, int]) -> None:
        face = self._faces[row]
        first, second = sorted(v for v in face if self._position_ids[v] in edge)
        if (first, second) not in made:
            made[first, second] = len(self._points)
            self._points.append((self._points[first] + self._points[second]) / 2)
            self._normals.append((self._normals[first] + self._normals[second]) / 2)
            self._position_ids.append(position_id)
        middle = made[first, second]
        for _, other in self._edges(row):
            if other != edge:
                self._rows[other].discard(row)
        self._faces[row] = [middle if v == first else v for v in face]
        self._faces.append([middle if v == second else v for v in face])
        self.origin.append(self.origin[row])
        self._enter(row)
        self._enter(len(self._faces) - 1)

    def _enter(self, row: int) -> None:
        for length_sq, edge in self._edges(row):
            if edge not in self._rows:
                self._rows[edge] = set()
                heapq.heappush(self._longest, (-length_sq, edge))
            self._rows[edge].add(row)

    def _edges(self, row: int) -> Iterator[tuple[float, Edge]]:
        face = self._faces[row]
        for a, b in zip(face, (*face[1:], face[0]), strict=True):
            offset = self._points[a] - self._points[b]
            pair = self._position_ids[a], self._position_ids[b]
            yield float(np.sum(offset * offset)), (min(pair), max(pair))
