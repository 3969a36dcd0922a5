"""A glTF as an object: all triangles of its scene, alone or with their materials."""

from collections.abc import Sequence

import numpy as np

from pipeline.foreign.gltf.document import GltfDocument, refuse_malformed
from pipeline.foreign.gltf.materials import DEFAULT, GltfMaterials
from pipeline.foreign.gltf.nodes import placed_meshes
from pipeline.foreign.gltf.primitives import PlacedPrimitive, placed_primitives
from pipeline.foreign.material import MOST_UV_SETS, TexturedMesh
from pipeline.foreign.mesh import TriangleMesh, join_meshes
from storage.errors import Rejected


def gltf_mesh(document: GltfDocument) -> TriangleMesh:
    """Return the triangles of a file in meters, +Z up.

    Raises:
        Rejected: load_error, index_range, no_faces, cut_off, unsupported_accessor.
    """
    with refuse_malformed("load_error", "the glTF tree is"):
        return _join_primitives(_list_primitives(document))


def gltf_textured_mesh(document: GltfDocument, materials: GltfMaterials) -> TexturedMesh:
    """Return the same triangles with their materials.

    Raises:
        Rejected: no_materials, materials_unreadable, or as reading a picture.
    """
    with refuse_malformed("materials_unreadable", "the materials are"):
        primitives = _list_primitives(document)
        has_colors = any(instance.colors is not None for instance in primitives)
        if not document.tree.get("materials") and not has_colors:
            raise Rejected("no_materials", "the glTF has no materials")
        known = materials.used_materials()
        rows: dict[int | None, int] = {number: row for row, number in enumerate(known)}
        numbers = [rows.get(instance.material, len(rows)) for instance in primitives]
        counts = [len(instance.faces) for instance in primitives]
        color = np.ones((sum(counts), 3, 3))
        uv = np.full((sum(counts), MOST_UV_SETS, 3, 2), np.nan)
        has_normal_maps = any(material.normal is not None for material in known.values())
        tangent = np.full((sum(counts), 3, 4), np.nan) if has_normal_maps else None
        for instance, last in zip(primitives, np.cumsum(counts), strict=True):
            span = slice(last - len(instance.faces), last)
            if (colors := instance.colors) is not None:
                color[span] = colors
            if tangent is not None and (tangents := instance.tangents) is not None:
                tangent[span] = tangents
            for number in range(MOST_UV_SETS):
                if (coordinates := instance.coordinates(number)) is not None:
                    uv[span, number] = coordinates
        return TexturedMesh(
            mesh=_join_primitives(primitives),
            material=np.repeat(numbers, counts),
            materials=(*known.values(), DEFAULT),
            uv=uv,
            tangent=tangent,
            color=None if (color == 1).all() else color,
        )


def _list_primitives(document: GltfDocument) -> list[PlacedPrimitive]:
    return [
        instance
        for placed in placed_meshes(document.tree)
        for instance in placed_primitives(document, placed)
    ]


def _join_primitives(primitives: Sequence[PlacedPrimitive]) -> TriangleMesh:
    if not any(len(instance.faces) for instance in primitives):
        raise Rejected("no_faces", "the file holds no triangles, or no node shows them")
    return join_meshes(
        [TriangleMesh(positions=each.positions, faces=each.faces) for each in primitives]
    )
