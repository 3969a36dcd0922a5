"""Pieces of a scene (floor, walls, objects, emitters), and their concatenation into its arrays.

A piece with a drawn texture gets one material that replaces its drawn ones: 8-bit maps, projected
along the six directions of a cube. Each triangle uses the side that it faces most, not mirrored, at
the stated width, with v up on the sides. The cube of floors and walls has the axes of the world, so
that each is one flat chart; the cube of an object rotates with it.

Objects may keep the materials of their source, and what emits in them becomes lamps. Files state
radiance in arbitrary units. All emitting components of a scene are scaled by one number, so that
together they give the stated fraction of the power of the drawn lamps; by less if the brightest of
them would outshine the brightest lamp. Like every emitter they have the reflectance of lamps, and
the camera does not see them.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.scenes.shading_normals import (
    ShadedMesh,
    face_crosses,
    flat_shaded,
    has_area,
    smooth_shaded,
)
from pipeline.scenes.triangle_budget import PooledAsset
from scene_templates.layout import Emitter, Layout, ShellPart, SurfaceLook
from scene_templates.sample_material import MaterialSettings
from scene_templates.scene_maps import (
    MOST_TEXTURED,
    TexturedLook,
    TextureSettings,
    UserMap,
    draw_look,
)
from scene_templates.surfaces.maps import SurfaceMaps
from storage.conventions import linear_from_srgb8, srgb8
from storage.errors import Rejected, TrilightError
from storage.records.asset import Level, LevelSkin
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS, SPECULAR, default_rows, laid_out
from storage.records.objects import LockedObject
from storage.records.scene import SceneObject
from storage.records.texture import CONSTANT, NORMAL, TEXTURED, MapSource, Texture
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

    def of_triangles(self, chosen: NDArray[np.bool_]) -> "Skin":
        """Return the skin of some triangles, a mask [T]."""
        uv = self.uv.reshape(-1, 3, 2)[chosen].reshape(-1, 2)
        emission = None if self.emission is None else self.emission[chosen]
        return dataclasses.replace(self, uv=uv, emission=emission)


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
    entry = SceneObject(name=part.name, kind="shell")
    positions = part.positions.astype(np.float32)
    return surface_piece(entry, positions, part.faces, part.surface, rng, smooth_angle_deg)


def surface_piece(
    entry: SceneObject,
    positions: NDArray[np.float32],
    faces: NDArray[np.uint32],
    surface: SurfaceLook,
    rng: np.random.Generator,
    smooth_angle_deg: float,
    skin: Skin | None = None,
) -> ScenePiece:
    """Return the piece of posed vertices [V, 3] in world space, and faces [F, 3].

    It has one row of materials, or one per shading group or triangle. Slivers are left out.

    Args:
        skin: textures that replace the material; it covers all faces, slivers included.

    Raises:
        Rejected: "no_faces" if no triangle has an area.
    """
    solid = has_area(positions, faces)
    if not solid.any():
        raise Rejected("no_faces", f"{entry.uid or entry.name}: none of its triangles has an area")
    if surface.smooth:
        mesh = smooth_shaded(positions, faces[solid], smooth_angle_deg)
    else:
        mesh = flat_shaded(positions, faces[solid])
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
    piece = ScenePiece(entry=entry, mesh=mesh, materials=materials, material_index=rows)
    return with_skin(piece, skin.of_triangles(solid)) if skin else piece


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


def concatenate_pieces(pieces: Sequence[ScenePiece]) -> dict[str, Any]:
    """Return the geometry, materials and textures of a Scene, in the order of the pieces."""
    vertex_starts = accumulate((len(piece.mesh.positions) for piece in pieces), initial=0)
    material_starts = accumulate((len(piece.materials) for piece in pieces), initial=0)
    counts = [len(piece.mesh.faces) for piece in pieces]
    return {
        "vertex_positions": np.concatenate([piece.mesh.positions for piece in pieces]),
        "vertex_normals": np.concatenate([piece.mesh.normals for piece in pieces]),
        "faces": np.concatenate(
            [
                piece.mesh.faces + np.uint32(start)
                for piece, start in zip(pieces, vertex_starts, strict=False)
            ]
        ),
        "material_index": np.concatenate(
            [
                piece.material_index + start
                for piece, start in zip(pieces, material_starts, strict=False)
            ]
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
    corners = []
    for piece in pieces:
        index = np.full((len(piece.materials), len(TEXTURED) + 1), CONSTANT, np.int32)
        uv = np.zeros((3 * len(piece.mesh.faces), 2), np.float32)
        if (skin := piece.skin) is not None:
            uv = skin.uv
            for column, texture in enumerate((*skin.textures, skin.normal)):
                if texture is not None:
                    textures.setdefault(texture.sha256, texture)
                    index[:, column] = list(textures).index(texture.sha256)
        rows.append(index)
        corners.append(uv)
    columns, normals = np.split(np.concatenate(rows), [len(TEXTURED)], axis=1)
    return {
        "uv": np.concatenate(corners),
        "textures": tuple(textures.values()),
        "material_textures": np.ascontiguousarray(columns),
        "normal_textures": normals.ravel() if (normals != CONSTANT).any() else None,
    }


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
    user_textures: Sequence[UserMap] = (),
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
    frames = [(np.eye(3), np.zeros(3))] * len(layout.shell)
    frames += [(each.pose.rotation, each.pose.centre) for each in layout.objects]
    result = list(pieces)
    textured = 0
    for row, (frame, origin) in enumerate(frames):
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
        source = dataclasses.replace(maps.source, name=f"{maps.source.name} {name}")
        return Texture(texels=upwards, is_srgb=is_srgb, source=source)

    return (
        texture(diffuse, "diffuse", is_srgb=True),
        texture(specular, "specular"),
        texture(roughness, "roughness"),
    )


def source_skins(
    chosen: Sequence[PooledAsset],
    levels: Sequence[Level],
    settings: MaterialSettings,
    scene_key: SceneKey,
) -> list[Skin | None]:
    """Return the skin of each object, or None if its materials are drawn.

    Each object has a random stream of its own, so that skins change no other draw of the scene, and
    another `own_share` changes none of the skins that stay.

    Args:
        settings: source of the materials, and the fraction of objects that keep theirs.

    Raises:
        Rejected: law_broken, which names the object.
    """
    if settings.source != "object":
        return [None] * len(chosen)
    skins: list[Skin | None] = []
    for row, (entry, level) in enumerate(zip(chosen, levels, strict=True)):
        rng = scene_key.rng("own materials", row)
        keeps = rng.random() < settings.own_share and level.skin is not None
        skins.append(_skin(level.skin, entry.locked) if keeps and level.skin else None)
    return skins


def _skin(skin: LevelSkin, locked: LockedObject) -> Skin:
    """Return a skin whose textures carry the rights of their object.

    Raises:
        Rejected: law_broken if the textures are invalid: an old version may have prepared them.
    """

    def with_rights(texture: Texture, column: str) -> Texture:
        source = MapSource(name=f"{locked.uid} {column}", **locked.rights)
        return dataclasses.replace(texture, source=source)

    try:
        first, second, third = map(with_rights, skin.textures, TEXTURED)
        normal = skin.normal and with_rights(skin.normal, NORMAL)
    except TrilightError as error:
        raise Rejected("law_broken", f"object {locked.uid}: {error}") from error
    uv = skin.uv.reshape(-1, 2)
    return Skin(uv=uv, textures=(first, second, third), normal=normal, emission=skin.emission)


def with_source_emission(
    objects: Sequence[ScenePiece], lamps: Sequence[ScenePiece], share: float
) -> tuple[list[ScenePiece], list[ScenePiece]]:
    """Return objects without their emitting triangles, and these as emitters.

    An object whose triangles all emit becomes an emitter in its place.

    Args:
        objects: pieces, some with skins that state the emission of their triangles.
        share: fraction of the lamps' power for all emitting triangles; 0 without lamps.
    """
    scale = _scale(objects, lamps, share)
    plain = [
        dataclasses.replace(each, skin=each.skin and dataclasses.replace(each.skin, emission=None))
        for each in objects
    ]
    if scale == 0:
        return plain, []
    taken = {piece.entry.name for piece in [*objects, *lamps]}
    reflected = lamps[0].materials[0, DIFFUSE]
    emitters = []
    for row, piece in enumerate(objects):
        emission = _emission(piece)
        emits: NDArray[np.bool_] = np.asarray(emission.any(axis=1))
        if not emits.any():
            continue
        names = (f"{piece.entry.name}_light{number or ''}" for number in range(len(taken) + 1))
        name = next(name for name in names if name not in taken)
        taken.add(name)
        entry = dataclasses.replace(piece.entry, name=name, kind="emitter")
        mesh = _part(plain[row], emits).mesh
        emitter = lamp_piece(entry, mesh, scale * emission[emits], reflected)
        if emits.all():
            plain[row] = emitter
        else:
            plain[row] = _part(plain[row], ~emits)
            emitters.append(emitter)
    return plain, emitters


def _scale(objects: Sequence[ScenePiece], lamps: Sequence[ScenePiece], share: float) -> float:
    stated = [(_emission(piece), _areas(piece)) for piece in objects]
    drawn = [(lamp.materials[lamp.material_index, EMISSION], _areas(lamp)) for lamp in lamps]
    (power, brightest), (drawn_power, greatest) = (
        (
            sum(float(areas @ rgb.astype(np.float64).mean(axis=1)) for rgb, areas in emitters),
            max((float(rgb.max(initial=0)) for rgb, _ in emitters), default=0.0),
        )
        for emitters in (stated, drawn)
    )
    if not (share and lamps and power > 0):
        return 0.0
    return min(share * drawn_power / power, greatest / brightest)


def _part(piece: ScenePiece, chosen: NDArray[np.bool_]) -> ScenePiece:
    """Return some triangles of a piece, without vertices that they do not use."""
    used, faces = np.unique(piece.mesh.faces[chosen], return_inverse=True)
    mesh = dataclasses.replace(
        piece.mesh,
        positions=piece.mesh.positions[used],
        normals=piece.mesh.normals[used],
        faces=faces.reshape(-1, 3).astype(np.uint32),
        groups=piece.mesh.groups[chosen],
    )
    skin = piece.skin.of_triangles(chosen) if piece.skin else None
    return dataclasses.replace(
        piece, mesh=mesh, material_index=piece.material_index[chosen], skin=skin
    )


def _emission(piece: ScenePiece) -> NDArray[np.float32]:
    """Return the stated radiance of an object's triangles, [T, 3]."""
    stated = None if piece.skin is None else piece.skin.emission
    return np.zeros((len(piece.mesh.faces), 3), np.float32) if stated is None else stated


def _areas(piece: ScenePiece) -> NDArray[np.float64]:
    cross = face_crosses(piece.mesh.positions, piece.mesh.faces)
    return np.asarray(np.linalg.norm(cross, axis=1) / 2)
