"""Converts the textures of a USD material to repeating textures over one set of coordinates.

A material has the coordinates of its first texture. A texture with other coordinates becomes its
mean, and so do all textures where the mesh has no coordinates.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.usd.foreign_meshes import TriangleSoup
from pipeline.exchange.usd.foreign_textures import ForeignTexture
from pipeline.exchange.wrapping import choose_tiles, expand_tiles, shift_near_zero
from storage.records.texture import MapSource, Texture

CHANNELS = {"diffuseColor": 3, "specularColor": 3, "metallic": 1, "roughness": 1, "ior": 1}
"""Channel count of each input that may be textured; the first textured one decides on uv."""


@dataclass(frozen=True, kw_only=True, eq=False)
class UvTextures:
    """Textures of a material, and the coordinates at which a mesh looks them up."""

    textures: Mapping[str, Texture]
    """Textures by name of the input; one texel where the mean replaces a texture."""
    uv: NDArray[np.float32] | None
    """[T, 3, 2] texture coordinates; None where no texture varies."""


def build_uv_textures(
    foreign_textures: Mapping[str, ForeignTexture],
    surface: TriangleSoup,
    time: Any,
    source: MapSource,
    lost: list[str],
) -> UvTextures:
    """Build the textures of a material on a mesh.

    Args:
        foreign_textures: pictures by name of the input, as in CHANNELS.
        surface: the mesh.
        time: time code of its coordinates.
        source: name and rights of the textures.
        lost: receives a sentence for each loss.
    """
    names = [name for name in CHANNELS if name in foreign_textures]
    where = surface.prim.GetPath()
    plain = {name: foreign_textures[name].texture(CHANNELS[name], source, lost) for name in names}
    if not names:
        return UvTextures(textures={}, uv=None)
    chart = foreign_textures[names[0]].chart
    uv = surface.read_coordinates(chart, time)
    if uv is None:
        lost.append(f"{where}: no coordinates {chart.primvar!r:.60}; textures replaced by means")
        return UvTextures(textures=_means(plain), uv=None)
    same_chart = [name for name in names if foreign_textures[name].chart == chart]
    if len(same_chart) < len(names):
        lost.append(
            f"{where}: textures of one material with several coordinates; replaced by means"
        )
    tiles_by_axis = []
    is_exact = True
    for axis in range(2):
        wraps = [foreign_textures[name].wrap[axis] for name in same_chart]
        most_texels = max(plain[name].texels.shape[1 - axis] for name in same_chart)
        tiles, fits = choose_tiles(wraps, uv[..., axis], most_texels)
        tiles_by_axis.append(tiles)
        is_exact &= fits
    textures = _means({name: plain[name] for name in names if name not in same_chart})
    for name in same_chart:
        across = expand_tiles(
            plain[name].texels, foreign_textures[name].wrap[0], tiles_by_axis[0], 1
        )
        texels = np.ascontiguousarray(
            expand_tiles(across, foreign_textures[name].wrap[1], tiles_by_axis[1], 0)
        )
        textures[name] = Texture(texels=texels, is_srgb=plain[name].is_srgb, source=source)
    moved = (uv - [tiles_by_axis[0].first, tiles_by_axis[1].first]) / [
        tiles_by_axis[0].count,
        tiles_by_axis[1].count,
    ]
    near, all_near = shift_near_zero(moved)
    if not (is_exact and all_near):
        lost.append(f"{where}: coordinates far outside [0, 1]; some textures look different there")
    return UvTextures(textures=textures, uv=near.astype(np.float32))


def _means(textures: Mapping[str, Texture]) -> dict[str, Texture]:
    return {
        name: Texture(texels=texture.mean.reshape(1, 1, -1), source=texture.source)
        for name, texture in textures.items()
    }
