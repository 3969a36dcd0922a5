"""Lookup of textures and environment maps at a point: the definition that kernels are tested by.

Both are interpolated bilinearly between the centres of their texels, in double precision. Textures
repeat along u and v; maps go round along u, and at the poles their last rows stand.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from storage.conventions import latlong_uv
from storage.records.environment import Environment
from storage.records.material import laid_out
from storage.records.normal_map import FLAT
from storage.records.texture import CONSTANT, TEXTURED, Texture

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
    places = {column.name: part for column, part in laid_out()}
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
    values: NDArray[np.float64] = (1 - across) * low + across * high
    return values
