"""The textures of one USD material over one mesh, as textures that repeat over one set of uv.

A material has the coordinates of its first texture. A texture with other coordinates becomes its
mean, and so do all where the mesh has no coordinates.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.usd.foreign_meshes import TriangleSoup
from pipeline.exchange.usd.foreign_textures import ForeignTexture
from pipeline.exchange.wrapping import repeated_near_zero, tiled, tiles_of
from storage.records.texture import MapSource, Texture

CHANNELS = {"diffuseColor": 3, "specularColor": 3, "metallic": 1, "roughness": 1, "ior": 1}
"""Inputs that may be textured, in the order in which they decide on coordinates."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Skinned:
    """What is looked up, and where."""

    textures: Mapping[str, Texture]
    """By the names of inputs; of one texel where the mean stands."""
    uv: NDArray[np.float32] | None
    """[T, 3, 2]; None where nothing is looked up."""


def skinned(
    found: Mapping[str, ForeignTexture],
    surface: TriangleSoup,
    time: Any,
    source: MapSource,
    lost: list[str],
) -> Skinned:
    """Return the textures of a material.

    Args:
        found: pictures by the names of inputs, as in CHANNELS.
        surface: the mesh.
        time: of its coordinates.
        source: names and rights of the textures.
        lost: receives what cannot be carried over.
    """
    names = [name for name in CHANNELS if name in found]
    where = surface.prim.GetPath()
    plain = {name: found[name].texture(CHANNELS[name], source, lost) for name in names}
    if not names:
        return Skinned(textures={}, uv=None)
    chart = found[names[0]].chart
    uv = surface.read_coordinates(chart, time)
    if uv is None:
        lost.append(f"{where}: no coordinates {chart.primvar!r:.60}; means of textures taken")
        return Skinned(textures=_means(plain), uv=None)
    kept = [name for name in names if found[name].chart == chart]
    if len(kept) < len(names):
        lost.append(f"{where}: textures of one material with several coordinates; means taken")
    axes, same = [], True
    for axis in range(2):
        wraps = [found[name].wrap[axis] for name in kept]
        texels = max(plain[name].texels.shape[1 - axis] for name in kept)
        tiles, fits = tiles_of(wraps, uv[..., axis], texels)
        axes.append(tiles)
        same &= fits
    textures = _means({name: plain[name] for name in names if name not in kept})
    for name in kept:
        across = tiled(plain[name].texels, found[name].wrap[0], axes[0], 1)
        whole = np.ascontiguousarray(tiled(across, found[name].wrap[1], axes[1], 0))
        textures[name] = Texture(texels=whole, is_srgb=plain[name].is_srgb, source=source)
    moved = (uv - [axes[0].first, axes[1].first]) / [axes[0].count, axes[1].count]
    near, all_near = repeated_near_zero(moved)
    if not (same and all_near):
        lost.append(f"{where}: textures far outside of [0, 1]; some look otherwise there")
    return Skinned(textures=textures, uv=near.astype(np.float32))


def _means(textures: Mapping[str, Texture]) -> dict[str, Texture]:
    return {
        name: Texture(texels=texture.mean.reshape(1, 1, -1), source=texture.source)
        for name, texture in textures.items()
    }
