"""A glTF as an object: all triangles that its scene shows, alone or with their materials."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.gltf.document import GltfDocument, refuse_malformed
from pipeline.foreign.gltf.materials import DEFAULT, GltfMaterials
from pipeline.foreign.gltf.nodes import placed_meshes
from pipeline.foreign.gltf.primitives import (
    GltfPrimitive,
    is_mirrored,
    place_points,
    read_primitives,
)
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.parts import MOST_UV_SETS, TexturedParts
from storage.errors import Rejected


def gltf_mesh(document: GltfDocument) -> TriangleMesh:
    """Return the triangles of a file in metres, +Z up.

    Raises:
        Rejected: load_error, index_range, no_faces, cut_off, unsupported_accessor.
    """
    with refuse_malformed("load_error", "the glTF tree is"):
        return _joined(_parts(document))


def gltf_parts(document: GltfDocument, materials: GltfMaterials) -> TexturedParts:
    """Return the same triangles with their materials.

    Raises:
        Rejected: no_materials, materials_unreadable, or as reading a picture.
    """
    with refuse_malformed("materials_unreadable", "the materials are"):
        parts = _parts(document)
        has_colors = any(part.primitive.colors is not None for part in parts)
        if not document.tree.get("materials") and not has_colors:
            raise Rejected("no_materials", "the glTF has no materials")
        known = materials.used()
        rows: dict[int | None, int] = {number: row for row, number in enumerate(known)}
        numbers = [rows.get(part.primitive.material, len(rows)) for part in parts]
        colour = np.concatenate([part.colors for part in parts])
        return TexturedParts(
            mesh=_joined(parts),
            material=np.repeat(numbers, [len(part.primitive.faces) for part in parts]),
            materials=(*known.values(), DEFAULT),
            uv=np.concatenate([part.coordinates for part in parts]),
            colour=None if (colour == 1).all() else colour,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Part:
    """One primitive in one of its places."""

    primitive: GltfPrimitive
    to_world: NDArray[np.float64]  # [4, 4]

    @property
    def mesh(self) -> TriangleMesh:
        points = place_points(self.primitive.positions, self.to_world)
        return TriangleMesh(positions=points, faces=self.turned(self.primitive.faces))

    @property
    def colors(self) -> NDArray[np.float64]:
        found = self.primitive.colors
        return np.ones((len(self.primitive.faces), 3, 3)) if found is None else self.turned(found)

    @property
    def coordinates(self) -> NDArray[np.float64]:
        sets = np.full((len(self.primitive.faces), MOST_UV_SETS, 3, 2), np.nan)
        for number in range(MOST_UV_SETS):
            found = self.primitive.coordinates(number)
            if found is not None:
                sets[:, number] = self.turned(found)
        return sets

    def turned(self, of_corners: NDArray) -> NDArray:
        """Return what corners [T, 3, ...] have in the order of a face that is seen from outside."""
        return of_corners[:, ::-1] if is_mirrored(self.to_world) else of_corners


def _parts(document: GltfDocument) -> list[_Part]:
    return [
        _Part(primitive=primitive, to_world=to_world)
        for place in placed_meshes(document.tree)
        for primitive in read_primitives(document, place.node)
        for to_world in document.instances(place)
    ]


def _joined(parts: Sequence[_Part]) -> TriangleMesh:
    meshes = [part.mesh for part in parts]
    if not any(len(mesh.faces) for mesh in meshes):
        raise Rejected("no_faces", "the file holds no triangles, or no node shows them")
    starts = np.cumsum([0, *(len(mesh.positions) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return TriangleMesh(
        positions=np.concatenate([mesh.positions for mesh in meshes]), faces=np.concatenate(faces)
    )
