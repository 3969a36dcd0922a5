"""A glTF as an object: all triangles of its scene, alone or with their materials."""

from collections.abc import Sequence

import numpy as np

from pipeline.foreign.gltf.document import GltfDocument, refuse_malformed
from pipeline.foreign.gltf.materials import DEFAULT, GltfMaterials
from pipeline.foreign.gltf.nodes import placed_meshes
from pipeline.foreign.gltf.primitives import PlacedPrimitive, placed_primitives
from pipeline.foreign.material import MOST_UV_SETS
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.parts import TexturedParts
from storage.errors import Rejected


def gltf_mesh(document: GltfDocument) -> TriangleMesh:
    """Return the triangles of a file in meters, +Z up.

    Raises:
        Rejected: load_error, index_range, no_faces, cut_off, unsupported_accessor.
    """
    with refuse_malformed("load_error", "the glTF tree is"):
        return _join_parts(_parts(document))


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
        known = materials.used_materials()
        rows: dict[int | None, int] = {number: row for row, number in enumerate(known)}
        numbers = [rows.get(part.primitive.material, len(rows)) for part in parts]
        counts = [len(part.faces) for part in parts]
        color = np.ones((sum(counts), 3, 3))
        uv = np.full((sum(counts), MOST_UV_SETS, 3, 2), np.nan)
        for part, last in zip(parts, np.cumsum(counts), strict=True):
            span = slice(last - len(part.faces), last)
            if (colors := part.colors) is not None:
                color[span] = colors
            for number in range(MOST_UV_SETS):
                if (coordinates := part.coordinates(number)) is not None:
                    uv[span, number] = coordinates
        return TexturedParts(
            mesh=_join_parts(parts),
            material=np.repeat(numbers, counts),
            materials=(*known.values(), DEFAULT),
            uv=uv,
            color=None if (color == 1).all() else color,
        )


def _parts(document: GltfDocument) -> list[PlacedPrimitive]:
    return [
        part
        for place in placed_meshes(document.tree)
        for part in placed_primitives(document, place)
    ]


def _join_parts(parts: Sequence[PlacedPrimitive]) -> TriangleMesh:
    if not any(len(part.faces) for part in parts):
        raise Rejected("no_faces", "the file holds no triangles, or no node shows them")
    starts = np.cumsum([0, *(len(part.positions) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
    return TriangleMesh(
        positions=np.concatenate([part.positions for part in parts]), faces=np.concatenate(faces)
    )
