"""Maps of linear values that are worked out per texel, and the textures that they become.

A map is [H, W, C] in float32 with its bottom row first, like a texture; a constant is a map of one
texel, and arithmetic between the two is numpy's. Where two maps are to be combined, the smaller one
is interpolated at the texels of the larger one. Textures that come of it have 8 bits, as those that
they came of: float32 would take four times the memory, for digits that nobody stated.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from storage.conventions import linear_from_srgb8, srgb8
from storage.records.lookup import texture_values
from storage.records.texture import MapSource, Texture

Map = NDArray[np.float32]

_ROWS = 256  # of a map that are interpolated at a time
_EXCESS = 1e-6
"""Two float32 albedos that add up to 1 may exceed it by their rounding."""


def constant_map(value: ArrayLike) -> Map:
    """Return the map of one texel of a number or a colour."""
    return np.atleast_1d(np.asarray(value, np.float32)).reshape(1, 1, -1)


def linear_map(texture: Texture) -> Map:
    """Return the linear values of a texture."""
    return texture.linear(texture.texels)


def is_constant(values: Map) -> bool:
    """Return whether a map is of one texel."""
    return values.shape[:2] == (1, 1)


def resample_to_largest(*maps: Map) -> tuple[Map, ...]:
    """Return maps of which all but constants have equally many texels: the most that any has."""
    sizes = [values.shape[:2] for values in maps if not is_constant(values)]
    if len(set(sizes)) < 2:
        return maps
    height, width = (max(size[axis] for size in sizes) for axis in range(2))
    return tuple(
        values if is_constant(values) else resample_map(values, height, width) for values in maps
    )


def resample_map(values: Map, height: int, width: int) -> Map:
    """Return a map at the centres of other texels, as it is looked up."""
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
    """Return the texture of numbers in [0, 1]; linear, in 8 bits unless it is a constant."""
    if is_constant(values):
        return Texture(texels=values, source=source)
    return Texture(texels=np.round(values * 255).astype(np.uint8), source=source)


def color_textures(diffuse: Map, specular: Map, source: MapSource) -> tuple[Texture, Texture]:
    """Return textures of two albedos, whose sum is at most 1 wherever they are looked up.

    The diffuse one gives way where they would add up to more.
    """
    diffuse, specular = resample_to_largest(diffuse, specular)
    glossy = _encode_color(specular, source)
    room = 1 - linear_map(glossy)
    if is_constant(diffuse) and (diffuse <= room.min(axis=(0, 1)) + _EXCESS).all():
        return Texture(texels=diffuse, source=source), glossy
    if is_constant(room) and is_constant(diffuse):
        return Texture(texels=np.minimum(diffuse, room), source=source), glossy
    limited = np.minimum(diffuse, room)
    codes = srgb8(limited)
    over = linear_from_srgb8()[codes] > room  # by rounding
    return Texture(texels=codes - over.astype(np.uint8), is_srgb=True, source=source), glossy


def may_exceed_one(diffuse: Texture, specular: Texture) -> bool:
    """Return whether two albedos may add up to more than 1 somewhere."""
    return bool((diffuse.greatest + specular.greatest > 1 + _EXCESS).any())


def _encode_color(values: Map, source: MapSource) -> Texture:
    if is_constant(values):
        return Texture(texels=values, source=source)
    return Texture(texels=srgb8(values), is_srgb=True, source=source)
