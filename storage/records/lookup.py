"""Lookup of textures and environment maps at a point: the definition that kernels are tested by.

Both are interpolated bilinearly between the centres of their texels, in double precision. Textures
repeat along u and v; maps go round along u, and at the poles their last rows stand.

A normal map says where the shading normal of a material points, in the frame of the unmapped one: x
along the direction in which u grows on the triangle, at right angles to that normal, z along the
normal, and y = z cross x. A texel holds (x + 1) / 2, (y + 1) / 2 and (z + 1) / 2. That is the frame
of Mitsuba's BSDF `normalmap`, and on charts that are not mirrored that of glTF and of Blender.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from storage.conventions import latlong_uv
from storage.records.material import column_places
from storage.records.texture import CONSTANT, TEXTURED, Environment, Texture

FLAT = (0.5, 0.5, 1.0)
"""Texel that leaves the normal as it is."""

LEAST_Z = 0.01
"""Least z of a normal before it has unit length: a surface shows no side that it does not have."""

LEAST_TANGENT_SQ = 1e-6
"""Least square of the length of a u direction at right angles to the normal: else no frame."""

_LEAST_AREA = 1e-12
"""Least area of a triangle on the texture, over the squares of its edges there."""


def u_directions(corners: NDArray[np.floating], uv: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the unit directions [T, 3] in which u grows on triangles; 0 where they have none.

    Args:
        corners: [T, 3, 3] positions.
        uv: [T, 3, 2] texture coordinates of the corners.
    """
    edges = (corners[:, 1:] - corners[:, :1]).astype(np.float64)
    steps = (uv[:, 1:].astype(np.float64) - uv[:, :1]).astype(np.float64)
    du, dv = np.moveaxis(steps, -1, 0)
    area = du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]
    along = (dv[:, 1:] * edges[:, 0] - dv[:, :1] * edges[:, 1]) * np.sign(area)[:, None]
    is_chart = np.abs(area) > _LEAST_AREA * np.square(steps).sum(axis=(1, 2))
    return unit_or_zero(np.where(is_chart[:, None], along, 0))


def mapped_normals(
    normals: NDArray[np.floating], u_direction: NDArray[np.floating], texels: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return shading normals [..., 3] by their map; unmapped where a frame has no u direction.

    Args:
        normals: [..., 3] unit, unmapped.
        u_direction: [..., 3] as of `u_directions`.
        texels: [..., 3] linear values of the map.
    """
    along = (u_direction * normals).sum(axis=-1, keepdims=True)
    tangent = u_direction - along * normals
    length_sq = np.square(tangent).sum(axis=-1, keepdims=True)
    is_frame = length_sq > LEAST_TANGENT_SQ
    tangent = tangent / np.sqrt(np.where(is_frame, length_sq, 1))
    x, y, z = np.split(2 * np.asarray(texels, np.float64) - 1, 3, axis=-1)
    bitangent = np.cross(normals, tangent)
    mapped = x * tangent + y * bitangent + np.maximum(z, LEAST_Z) * normals
    with np.errstate(invalid="ignore"):
        mapped = mapped / np.sqrt(np.square(mapped).sum(axis=-1, keepdims=True))
    return np.where(is_frame, mapped, normals)


def unit_or_zero(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return vectors [..., 3] at unit length; those without length, or not finite, are 0."""
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        scaled = vectors / np.abs(vectors).max(axis=-1, keepdims=True, initial=0)
        units = scaled / np.sqrt(np.square(scaled).sum(axis=-1, keepdims=True))
    return np.where(np.isfinite(units), units, 0)


if TYPE_CHECKING:
    from storage.records.scene import Scene

Texels = Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray]


def texture_values(texture: Texture, uv: ArrayLike) -> NDArray[np.float64]:
    """Return the linear values [..., C] of a texture at finite coordinates [..., 2]."""
    height, width = texture.texels.shape[:2]
    u, v = np.moveaxis(np.asarray(uv, np.float64), -1, 0)
    # first, so that far coordinates lose no digits
    u = u - np.floor(u)
    v = v - np.floor(v)

    def texels(row: NDArray[np.int64], column: NDArray[np.int64]) -> NDArray:
        return texture.linear(texture.texels[row % height, column % width])

    return _bilinear(texels, u * width - 0.5, v * height - 0.5)


def environment_values(environment: Environment, directions: ArrayLike) -> NDArray[np.float64]:
    """Return the radiance [..., 3] that comes from directions [..., 3] of the world."""
    radiance = environment.radiance_rgb
    height, width = radiance.shape[:2]
    u, v = np.moveaxis(latlong_uv(environment.to_map(directions)), -1, 0)

    def texels(row: NDArray[np.int64], column: NDArray[np.int64]) -> NDArray:
        return radiance[np.clip(row, 0, height - 1), column % width]

    return _bilinear(texels, u * width - 0.5, (1 - v) * height - 0.5)


def textured_rows(
    scene: "Scene", material_index: NDArray[np.integer], uv: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Return the material rows [N, M] of places on surfaces, with their textures.

    Args:
        scene: passes `Scene.check`.
        material_index: [N] rows of `scene.materials`.
        uv: [N, 2] texture coordinates there.
    """
    rows = scene.materials[material_index]
    if scene.material_textures is None:
        return rows
    places = column_places()
    for name, textures_N in zip(TEXTURED, scene.material_textures[material_index].T, strict=True):
        for texture in np.unique(textures_N[textures_N != CONSTANT]):
            chosen = textures_N == texture
            rows[chosen, places[name]] = texture_values(scene.textures[texture], uv[chosen])
    return rows


def normal_texels(
    scene: "Scene", material_index: NDArray[np.integer], uv: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the values [N, 3] of normal maps at places on surfaces; arguments as `textured_rows`.

    Where a material has none, it is a flat one.
    """
    texels = np.tile(FLAT, (len(uv), 1))
    if scene.normal_textures is not None:
        rows = scene.normal_textures[material_index]
        for row in np.unique(rows[rows != CONSTANT]):
            chosen = rows == row
            texels[chosen] = texture_values(scene.textures[row], uv[chosen])
    return texels


def _bilinear(
    texels: Texels, x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return values at x and y, counted in texels from the centre of the first."""
    column = np.floor(x).astype(np.int64)
    row = np.floor(y).astype(np.int64)
    along = (x - column)[..., None]
    across = (y - row)[..., None]
    low = (1 - along) * texels(row, column) + along * texels(row, column + 1)
    high = (1 - along) * texels(row + 1, column) + along * texels(row + 1, column + 1)
    return (1 - across) * low + across * high
