"""Draws textures for the pieces of a scene: 8-bit maps, and uv by projection.

A piece gets one material that replaces its drawn ones. Its texture is projected along the six
directions of a cube: each triangle uses the side that it faces most, not mirrored, at the stated
width, with v up on the sides. The cube of floors and walls has the axes of the world, so that each
is one flat chart; the cube of an object rotates with it.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.scenes.pieces import ScenePiece, Skin, with_skin
from scene_templates.layout import Layout
from scene_templates.surfaces.maps import SurfaceMaps
from scene_templates.textures import MOST_TEXTURED, TexturedLook, TextureSettings, draw_look
from scene_templates.user_maps import UserMap, UserTexture
from storage.conventions import linear_from_srgb8, srgb8
from storage.records.texture import Texture
from storage.seeds import SceneKey

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
        layout: poses of the objects.
        settings: fraction of textured pieces, and ranges.
        scene_key: seed, index and attempt of the scene.
        user_textures: the user's textures.
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
    uv = look.uv(cube_coordinates(_to_object_axes(corners - origin, frame)))
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


def _to_object_axes(points: NDArray[np.float64], frame: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points [T, 3, 3] in the axes of an object, whose rotation is `frame`."""
    x, y, z = (points[..., row, None] * frame[row] for row in range(3))
    return x + y + z


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
