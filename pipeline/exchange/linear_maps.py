"""Maps of linear values, computed per texel, and their conversion to textures.

A map is [H, W, C] in float32 with its bottom row first, like a texture. A constant is a map of one
texel, which numpy broadcasts. Where two maps are combined, the smaller one is interpolated at the
texels of the larger one. The resulting textures have 8 bits, as their sources have: float32 would
take four times the memory for digits that no source states.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from storage.conventions import linear_from_srgb8, srgb8
from storage.records.lookup import texture_values
from storage.records.texture import MapSource, Texture

Map = NDArray[np.float32]

_ROWS = 256  # rows of a map that are interpolated at a time
EXCESS = 1e-6
"""Tolerance for the rounding of two float32 albedos that add up to 1."""


def constant_map(value: ArrayLike) -> Map:
    """Return a number or a color as a map of one texel."""
    return np.atleast_1d(np.asarray(value, np.float32)).reshape(1, 1, -1)


def linear_map(texture: Texture) -> Map:
    """Return the linear values of a texture."""
    return texture.linear(texture.texels)


def is_constant(values: Map) -> bool:
    """Return whether a map has one texel."""
    return values.shape[:2] == (1, 1)


def resample_to_largest(*maps: Map) -> tuple[Map, ...]:
    """Resample all maps but constants to the size of the largest in each direction."""
    sizes = [values.shape[:2] for values in maps if not is_constant(values)]
    if len(set(sizes)) < 2:
        return maps
    height, width = (max(size[axis] for size in sizes) for axis in range(2))
    return tuple(
        values if is_constant(values) else resample_map(values, height, width) for values in maps
    )


def resample_map(values: Map, height: int, width: int) -> Map:
    """Interpolate a map at the texel centers of another size, as texture look-ups do."""
    if values.shape[:2] == (height, width):
        return values
    texture = Texture(texels=values)
    u, v = ((np.arange(count) + 0.5) / count for count in (width, height))
    resampled = np.zeros((height, width, values.shape[2]), np.float32)
    for first in range(0, height, _ROWS):
        uv = np.stack(np.meshgrid(u, v[first : first + _ROWS]), axis=-1)
        resampled[first : first + _ROWS] = texture_values(texture, uv)
    return resampled


def number_texture(values: Map, source: MapSource) -> Texture:
    """Return a linear texture of numbers in [0, 1], in 8 bits unless it is a constant."""
    if is_constant(values):
        return Texture(texels=values, source=source)
    return Texture(texels=np.round(values * 255).astype(np.uint8), source=source)


def color_textures(diffuse: Map, specular: Map, source: MapSource) -> tuple[Texture, Texture]:
    """Return textures of two albedos whose sum is at most 1 at every look-up.

    The diffuse one is lowered where they would add up to more.
    """
    diffuse, specular = resample_to_largest(diffuse, specular)
    glossy = Texture(texels=specular, source=source)
    if not is_constant(specular):
        glossy = Texture(texels=srgb8(specular), is_srgb=True, source=source)
    room = 1 - linear_map(glossy)
    if is_constant(diffuse) and (diffuse <= room.min(axis=(0, 1)) + EXCESS).all():
        return Texture(texels=diffuse, source=source), glossy
    if is_constant(room) and is_constant(diffuse):
        return Texture(texels=np.minimum(diffuse, room), source=source), glossy
    limited = np.minimum(diffuse, room)
    codes = srgb8(limited)
    over = linear_from_srgb8()[codes] > room  # by rounding
    return Texture(texels=codes - over.astype(np.uint8), is_srgb=True, source=source), glossy
