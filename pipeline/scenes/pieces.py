"""Pieces of a scene (floor, walls, objects, emitters), and their concatenation into its arrays.

A piece with a drawn texture gets one material that replaces its drawn ones: 8-bit maps, projected
along the six directions of a cube. Each triangle uses the side that it faces most, not mirrored, at
the stated width, with v up on the sides. The cube of floors and walls has the axes of the world, so
that each is one flat chart; the cube of an object rotates with it.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.scenes.shading_normals import (
    ShadedMesh,
    flat_shaded,
    not_slivers,
    smooth_shaded,
    without_slivers,
)
from scene_templates.layout import Emitter, Layout, ShellPart, SurfaceLook
from scene_templates.surfaces.maps import SurfaceMaps
from scene_templates.textures import (
    MOST_TEXTURED,
    TexturedLook,
    TextureSettings,
    UserMap,
    UserTexture,
    draw_look,
)
from storage.conventions import linear_from_srgb8, srgb8
from storage.errors import Rejected, TrilightError
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS, SPECULAR, default_rows, laid_out
from storage.records.scene import SceneObject
from storage.records.texture import CONSTANT, TEXTURED, Texture
from storage.seeds import SceneKey


@dataclass(frozen=True, kw_only=True, eq=False)
class Skin:
    """The textures of a piece, whose material is one row."""

    uv: NDArray[np.float32]
    """[3T, 2] texture coordinates of each corner of each triangle."""
    textures: tuple[Texture, Texture, Texture]
    """Textures of the diffuse, specular and roughness columns."""
    normal: Texture | None = None
    """Normal map; by default none."""
    uid: str = ""
    """uid of a user's texture, as objects.lock.jsonl names it; empty for others."""
    emission: NDArray[np.float32] | None = None
    """[T, 3] stated radiance of an object's triangles, until they become emitters."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ScenePiece:
    """One row of `Scene.objects` with its triangles and materials."""

    entry: SceneObject
    """Name, kind and rights of the piece."""
    mesh: ShadedMesh
    """Mesh of the piece in world space."""
    materials: NDArray[np.float32]
    """[M, 10 or more], every declared column (storage.records.material)."""
    material_index: NDArray[np.int64]
    """[T] row of `materials` of each triangle."""
    skin: Skin | None = None
    """Textures that replace columns of the material; by default none."""


def shell_piece(part: ShellPart, rng: np.random.Generator, smooth_angle_deg: float) -> ScenePiece:
    """Return a floor or wall; if it has many colors, `rng` draws one per triangle."""
    positions = part.positions.astype(np.float32)
    mesh = _shade_mesh(positions, part.faces, part.surface, smooth_angle_deg)
    return _apply_surface(SceneObject(name=part.name, kind="shell"), mesh, part.surface, rng)


def object_piece(
    entry: SceneObject,
    positions: NDArray[np.float32],
    faces: NDArray[np.uint32],
    surface: SurfaceLook,
    rng: np.random.Generator,
    smooth_angle_deg: float,
) -> ScenePiece:
    """Return an object of posed vertices [V, 3] in world space, and faces [F, 3].

    Raises:
        Rejected: "no_faces" if no triangle has an area.
    """
    faces = without_slivers(positions, faces)
    if len(faces) == 0:
        raise Rejected("no_faces", f"{entry.uid}: no triangle of the level has an area")
    return _apply_surface(
        entry, _shade_mesh(positions, faces, surface, smooth_angle_deg), surface, rng
    )


def apply_skin(
    piece: ScenePiece, positions: NDArray[np.float32], faces: NDArray[np.uint32], skin: Skin
) -> ScenePiece:
    """Return the piece of `object_piece` with a skin that covers all faces, slivers included."""
    has_area = not_slivers(positions, faces)
    uv = skin.uv.reshape(-1, 3, 2)[has_area].reshape(-1, 2)
    emission = None if skin.emission is None else skin.emission[has_area]
    return with_skin(piece, dataclasses.replace(skin, uv=uv, emission=emission))


def with_skin(piece: ScenePiece, skin: Skin) -> ScenePiece:
    """Return a piece whose material is replaced by textures; its row has their means."""
    materials = default_rows(1)
    for part, texture in zip((DIFFUSE, SPECULAR, ROUGHNESS), skin.textures, strict=True):
        materials[:, part] = texture.mean if part != ROUGHNESS else texture.mean[0]
    return dataclasses.replace(
        piece,
        materials=materials,
        material_index=np.zeros(len(piece.mesh.faces), np.int64),
        skin=skin,
    )


def emitter_piece(emitter: Emitter, row: int) -> ScenePiece:
    """Return an emitter: one triangle with a material row of its own."""
    mesh = flat_shaded(emitter.triangle.astype(np.float32), np.array([[0, 1, 2]], np.uint32))
    entry = SceneObject(name=f"emitter{row}", kind="emitter")
    return lamp_piece(entry, mesh, np.array([emitter.radiance_rgb]), emitter.reflectance)


def lamp_piece(
    entry: SceneObject,
    mesh: ShadedMesh,
    radiance_rgb: NDArray[np.floating],
    reflectance: NDArray[np.float32] | float,
) -> ScenePiece:
    """Return an emitter whose triangles have these radiances [T, 3]."""
    rows, index = np.unique(radiance_rgb.astype(np.float32), axis=0, return_inverse=True)
    materials = default_rows(len(rows))
    materials[:, DIFFUSE] = reflectance
    materials[:, ROUGHNESS] = 1.0
    materials[:, EMISSION] = rows
    return ScenePiece(entry=entry, mesh=mesh, materials=materials, material_index=index.ravel())


def _shade_mesh(
    positions: NDArray[np.float32],
    faces: NDArray[np.uint32],
    surface: SurfaceLook,
    smooth_angle_deg: float,
) -> ShadedMesh:
    if surface.smooth:
        return smooth_shaded(positions, faces, smooth_angle_deg)
    return flat_shaded(positions, faces)


def _apply_surface(
    entry: SceneObject, mesh: ShadedMesh, surface: SurfaceLook, rng: np.random.Generator
) -> ScenePiece:
    """Return the piece of a mesh with materials: one row, or one per shading group or triangle."""
    rows = {
        "one": np.zeros(len(mesh.faces), np.int64),
        "groups": mesh.groups,
        "triangles": np.arange(len(mesh.faces)),
    }[surface.colours]
    diffuse = np.array([surface.diffuse_rgb])
    if surface.colours != "one":
        diffuse = surface.diffuse_scale * rng.random((int(rows.max()) + 1, 3))
    materials = default_rows(len(diffuse))
    materials[:, DIFFUSE] = diffuse
    materials[:, SPECULAR] = surface.specular_rgb
    materials[:, ROUGHNESS] = surface.roughness
    return ScenePiece(entry=entry, mesh=mesh, materials=materials, material_index=rows)


def concatenate_pieces(pieces: Sequence[ScenePiece]) -> dict[str, Any]:
    """Return the geometry, materials and textures of a Scene, in the order of the pieces."""
    vertex_start = _starts([len(piece.mesh.positions) for piece in pieces])
    material_start = _starts([len(piece.materials) for piece in pieces])
    rows = range(len(pieces))
    counts = [len(piece.mesh.faces) for piece in pieces]
    return {
        "vertex_positions": np.concatenate([piece.mesh.positions for piece in pieces]),
        "vertex_normals": np.concatenate([piece.mesh.normals for piece in pieces]),
        "faces": np.concatenate(
            [pieces[row].mesh.faces + np.uint32(vertex_start[row]) for row in rows]
        ),
        "material_index": np.concatenate(
            [pieces[row].material_index + material_start[row] for row in rows]
        ).astype(np.uint16),
        "materials": np.concatenate([piece.materials for piece in pieces]),
        "object_index": np.repeat(np.arange(len(pieces)), counts).astype(np.uint16),
        **_skins(pieces),
    }


def _skins(pieces: Sequence[ScenePiece]) -> dict[str, Any]:
    """Return the texture fields of a Scene; empty if no piece has textures."""
    if all(piece.skin is None for piece in pieces):
        return {}
    textures = dict[str, Texture]()
    rows = []
    normals = []
    corners = []
    for piece in pieces:
        index = np.full((len(piece.materials), len(TEXTURED)), CONSTANT, np.int32)
        uv = np.zeros((3 * len(piece.mesh.faces), 2), np.float32)
        if piece.skin is not None:
            for texture in piece.skin.textures:
                textures.setdefault(texture.sha256, texture)
            index[:] = [list(textures).index(each.sha256) for each in piece.skin.textures]
            uv = piece.skin.uv
        normal = np.full(len(index), CONSTANT, np.int32)
        if piece.skin is not None and piece.skin.normal is not None:
            textures.setdefault(piece.skin.normal.sha256, piece.skin.normal)
            normal[:] = list(textures).index(piece.skin.normal.sha256)
        rows.append(index)
        normals.append(normal)
        corners.append(uv)
    of_normals = np.concatenate(normals)
    return {
        "uv": np.concatenate(corners),
        "textures": tuple(textures.values()),
        "material_textures": np.concatenate(rows),
        "normal_textures": of_normals if (of_normals != CONSTANT).any() else None,
    }


def _starts(counts: Sequence[int]) -> list[int]:
    return [sum(counts[:row]) for row in range(len(counts))]


def with_drawn_columns(materials: NDArray[np.float32], scene_key: SceneKey) -> NDArray[np.float32]:
    """Return the material rows of a scene with values for the columns that have a draw.

    Each column has a random stream of its own, so that it changes no other draw of the scene. Rows
    that emit keep the default.

    Args:
        materials: rows with all declared columns, which stay unchanged.

    Raises:
        TrilightError: a draw returns another shape, or a value outside of its column's range.
    """
    drawn = materials.copy()
    reflects = (materials[:, EMISSION] == 0).all(axis=1)
    for column, part in laid_out():
        if column.draw is None:
            continue
        rng = scene_key.rng(f"material column {column.name}")
        values = np.asarray(column.draw(rng, int(reflects.sum())), np.float32)
        shape = (int(reflects.sum()), column.width)
        if values.shape != shape or not np.all(column.within.holds(values)):
            raise TrilightError(
                f"material column {column.name!r}: its draw returned shape {values.shape}; "
                f"expected {shape}, with every number {column.within}."
            )
        drawn[reflects, part] = values
    return drawn


_RIGHT = np.array([[0, 1, 0], [0, -1, 0], [-1, 0, 0], [1, 0, 0], [1, 0, 0], [-1, 0, 0]], np.float64)
_UP = np.array([[0, 0, 1]] * 4 + [[0, 1, 0]] * 2, np.float64)
"""[6, 3] directions of u and v on the sides +x, -x, +y, -y, +z and -z: right x up is the normal."""


def with_drawn_textures(
    pieces: Sequence[ScenePiece],
    layout: Layout,
    settings: TextureSettings,
    scene_key: SceneKey,
    *,
    user_textures: Sequence[UserMap[UserTexture]] = (),
) -> list[ScenePiece]:
    """Return the pieces, some with drawn textures; emitters have none.

    Each piece has a random stream of its own, so that textures change no other draw of the scene.

    Args:
        pieces: floor and walls, objects and emitters, in the order of `layout`.
        settings: fraction of textured pieces, and ranges.
    """
    if settings.share == 0:
        return list(pieces)
    licences = [piece.entry.licence for piece in pieces]
    frames = [np.eye(3)] * len(layout.shell)
    frames += [placement.pose.rotation for placement in layout.objects]
    origins = [np.zeros(3)] * len(layout.shell)
    origins += [placement.pose.centre for placement in layout.objects]
    result = list(pieces)
    textured = 0
    for row, (frame, origin) in enumerate(zip(frames, origins, strict=True)):
        rng = scene_key.rng("texture", row)
        look = (
            draw_look(rng, settings, user_textures, licences) if textured < MOST_TEXTURED else None
        )
        piece = pieces[row]  # materials of its source come first
        if look is not None and piece.skin is None and piece.entry.kind != "emitter":
            licences.append(look.maps.source.licence)
            result[row] = _apply_texture(piece, look, frame, origin)
            textured += 1
    return result


def _apply_texture(
    piece: ScenePiece, look: TexturedLook, frame: NDArray[np.float64], origin: NDArray[np.float64]
) -> ScenePiece:
    corners = piece.mesh.positions[piece.mesh.faces].astype(np.float64)
    points = corners - origin
    x, y, z = (points[..., row, None] * frame[row] for row in range(3))
    uv = look.uv(cube_coordinates(x + y + z))  # in the axes of the object
    skin = Skin(
        uv=uv.astype(np.float32).reshape(-1, 2), textures=_textures(look.maps), uid=look.uid
    )
    return with_skin(piece, skin)


def cube_coordinates(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return cube-projected coordinates [T, 3, 2], right and up, of triangle corners [T, 3, 3].

    A triangle that faces two sides equally belongs to the first of x, y and z.
    """
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.abs(normal).argmax(axis=1)
    side = 2 * axis + (np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] < 0)
    axes = np.stack([_RIGHT[side], _UP[side]], axis=1)[:, None]  # [T, 1, 2, 3]
    return np.asarray((corners[:, :, None] * axes).sum(axis=-1))


def _textures(maps: SurfaceMaps) -> tuple[Texture, Texture, Texture]:
    """Return diffuse (sRGB), specular and roughness in 8 bits, the bottom row first."""
    diffuse = srgb8(maps.diffuse_rgb)
    specular, roughness = (
        np.round(values.astype(np.float64) * 255).astype(np.uint8)
        for values in (maps.specular_rgb, maps.roughness)
    )
    # Both are rounded: if they would add up to more than 1, the specular one is reduced.
    over = linear_from_srgb8()[diffuse] + specular / 255 > 1
    specular = np.where(over, specular - 1, specular).astype(np.uint8)

    def texture(texels: NDArray[np.uint8], name: str, *, is_srgb: bool = False) -> Texture:
        upwards = np.ascontiguousarray(texels[::-1])
        source = dataclasses.replace(maps.source, name=f"{maps.family} {name}")
        return Texture(texels=upwards, is_srgb=is_srgb, source=source)

    return (
        texture(diffuse, "diffuse", is_srgb=True),
        texture(specular, "specular"),
        texture(roughness, "roughness"),
    )
