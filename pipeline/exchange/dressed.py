"""Pieces of a stranger's scene with their materials and textures, and how they join into a Scene.

Triangles come with three corners of their own; corners of equal position and normal become one
vertex, and equal materials one row. Textures of one colour become constants.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.scenes.pieces import ScenePiece, concatenate_pieces
from pipeline.scenes.shading import ShadedMesh
from storage.records.material import EMISSION, distinct_rows, laid_out
from storage.records.retextured import AnyScene, with_textures
from storage.records.scene import ObjectKind, Scene, SceneObject
from storage.records.texture import CONSTANT, TEXTURED, Texture

Worn = tuple[Texture | None, Texture | None, Texture | None]
"""Textures in the order of TEXTURED; None where the column of the row stands."""

PLAIN: Worn = (None, None, None)

_SMALLEST_DOUBLE_AREA = 1e-12
"""In square metres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DressedTriangles:
    """Triangles with a material each."""

    positions: NDArray[np.float32]
    """[T, 3, 3] world."""
    normals: NDArray[np.float32]
    """[T, 3, 3] unit."""
    rows: NDArray[np.float32]
    """[T, 10 or more] material columns; what they say of textured columns counts for nothing."""
    uv: NDArray[np.float32]
    """[T, 3, 2] texture coordinates of the corners; any where nothing is textured."""
    worn: NDArray[np.int64]
    """[T] row of `wardrobe`."""
    wardrobe: Sequence[Worn]
    """Textures that a triangle may have."""

    def chosen(self, part: NDArray[np.bool_]) -> "DressedTriangles":
        """Return some of them."""
        return DressedTriangles(
            positions=self.positions[part],
            normals=self.normals[part],
            rows=self.rows[part],
            uv=self.uv[part],
            worn=self.worn[part],
            wardrobe=self.wardrobe,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class DressedPiece:
    """One object of a scene with its textures."""

    piece: ScenePiece
    """Without them."""
    uv: NDArray[np.float32]
    """[T, 3, 2]"""
    worn: tuple[Worn, ...]
    """Textures of each of its material rows."""


def have_areas(corners: NDArray[np.floating], cross: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether triangles [T, 3, 3] have an area; `cross` [T, 3] are as long as twice theirs.

    In a mesh below a metre that is measured by its size: triangles of a watch are small.
    """
    size = min(float(np.ptp(corners.reshape(-1, 3), axis=0).max()), 1.0) if corners.size else 1.0
    return np.asarray(np.linalg.norm(cross, axis=1) > _SMALLEST_DOUBLE_AREA * size**2)


def by_kind(triangles: DressedTriangles) -> list[tuple[ObjectKind, DressedTriangles]]:
    """Return the part that reflects, and the part that emits, where there are both."""
    emits = (triangles.rows[:, EMISSION] > 0).any(axis=1)
    kinds: list[tuple[ObjectKind, NDArray[np.bool_]]] = [
        ("object", np.logical_not(emits)),
        ("emitter", np.asarray(emits)),
    ]
    return [(kind, triangles.chosen(part)) for kind, part in kinds if part.any()]


def dressed(entry: SceneObject, triangles: DressedTriangles) -> DressedPiece:
    """Return triangles as an object of a scene."""
    corners = np.concatenate([triangles.positions, triangles.normals], axis=2).reshape(-1, 6)
    first, index = distinct_rows(corners)
    kept, faces = corners[first], index.reshape(-1, 3).astype(np.uint32)
    rows = _with_means(triangles)
    looks = np.column_stack([rows, triangles.worn.astype(np.float32)])
    palette, material_index = distinct_rows(looks)
    mesh = ShadedMesh(
        positions=kept[:, :3].copy(),
        normals=kept[:, 3:].copy(),
        faces=faces,
        groups=np.zeros(len(faces), np.int64),
    )
    return DressedPiece(
        piece=ScenePiece(
            entry=entry, mesh=mesh, materials=rows[palette], material_index=material_index
        ),
        uv=triangles.uv,
        worn=tuple(_varying(triangles.wardrobe[row]) for row in triangles.worn[palette]),
    )


def joined_arrays(pieces: Sequence[DressedPiece]) -> dict[str, Any]:
    """Return geometry and materials of a Scene, without the textures."""
    return concatenate_pieces([each.piece for each in pieces])


def with_worn_textures(scene: AnyScene, pieces: Sequence[DressedPiece]) -> AnyScene:
    """Return a scene of these pieces, in their order, with their textures."""
    textures: dict[str, Texture] = {}
    index: list[list[int]] = []
    order: dict[str, int] = {}
    for worn in (worn for each in pieces for worn in each.worn):
        for texture in worn:
            if texture is not None and texture.sha256 not in textures:
                order[texture.sha256] = len(textures)
                textures[texture.sha256] = texture
        index.append([CONSTANT if texture is None else order[texture.sha256] for texture in worn])
    if not textures:
        return scene
    uv = np.concatenate([each.uv.reshape(-1, 2) for each in pieces]).astype(np.float32)
    rows = np.array(index, np.int32).reshape(-1, len(TEXTURED))
    return with_textures(scene, uv, tuple(textures.values()), rows)


def _with_means(triangles: DressedTriangles) -> NDArray[np.float32]:
    """Return the rows with the means of textures, so that equal looks are equal."""
    rows, places = triangles.rows.copy(), {column.name: part for column, part in laid_out()}
    for number, worn in enumerate(triangles.wardrobe):
        chosen = np.flatnonzero(triangles.worn == number)
        for name, texture in zip(TEXTURED, worn, strict=True):
            if texture is not None and len(chosen):
                same = texture.constant
                rows[chosen, places[name]] = texture.mean if same is None else same
    return rows


def _varying(worn: Worn) -> Worn:
    """Return textures without those of one colour, which stand in the columns."""
    one, two, three = (
        None if texture is None or texture.constant is not None else texture for texture in worn
    )
    return one, two, three


def scene_with_worn(arrays: dict[str, Any], pieces: Sequence[DressedPiece], **more: Any) -> Scene:
    """Return the checked scene of joined arrays, its textures, and the other members."""
    scene = Scene(**arrays, objects=tuple(each.piece.entry for each in pieces), **more)
    scene = with_worn_textures(scene, pieces)
    scene.check()
    return scene
