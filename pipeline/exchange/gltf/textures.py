"""The textures of a glTF material, as maps of linear values over the coordinates of a mesh.

A material has one set of coordinates here: that of its first texture. A texture with others becomes
its mean. glTF counts v from the top row of a picture, ours from the bottom one.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.gltf.document import GltfDocument, extension
from pipeline.exchange.linear_maps import Map, constant_map
from pipeline.exchange.pictures import decoded_pixels
from pipeline.exchange.wrapping import Wrap, repeated_near_zero, tiled, tiles_of
from storage.conventions import linear_from_srgb8

Coordinates = Callable[[int], NDArray[np.float32] | None]
"""Gives a set of texture coordinates [T, 3, 2] of a mesh by its number."""

_WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}


@dataclass(frozen=True, kw_only=True, eq=False)
class Sampled:
    """What the textures of a material say over a mesh."""

    maps: Mapping[str, Map]
    """By what they are for: [H, W, 4] linear, the bottom row first; absent where none is used."""
    uv: NDArray[np.float32] | None
    """[T, 3, 2] where the maps are looked up; None where all are constants."""


def sampled(
    document: GltfDocument,
    infos: Mapping[str, dict[str, Any]],
    encoded: frozenset[str],
    coordinates: Coordinates,
    lost: list[str],
) -> Sampled:
    """Return the maps of a material.

    Args:
        document: the file.
        infos: its `textureInfo`s by what they are for; the first one decides on coordinates.
        encoded: those whose colours are sRGB-encoded.
        coordinates: of the mesh.
        lost: receives what cannot be carried over.

    Raises:
        TrilightError: a picture is outside of the folder, on the network, or too large.
    """
    found = {name: _picture(document, info, name in encoded, lost) for name, info in infos.items()}
    pictures = {name: picture for name, picture in found.items() if picture is not None}
    charts = {name: _chart(infos[name]) for name in pictures}
    first = next(iter(charts.values()), None)
    uv = None if first is None else _placed(coordinates(first[0]), first)
    if pictures and uv is None:
        lost.append("textures of a mesh without texture coordinates: their means were taken")
    kept = [name for name in pictures if uv is not None and charts[name] == first]
    if uv is not None and len(kept) < len(pictures):
        lost.append("textures with coordinates unlike the first of their material: their means")
    maps = {name: constant_map(picture.mean(axis=(0, 1))) for name, picture in pictures.items()}
    if uv is None:
        return Sampled(maps=maps, uv=None)
    wraps = {name: _wraps(document, infos[name]) for name in kept}
    axes, same = [], True
    for axis in range(2):
        texels = max(pictures[name].shape[1 - axis] for name in kept)
        tiles, fits = tiles_of([wraps[name][axis] for name in kept], uv[..., axis], texels)
        axes.append(tiles)
        same &= fits
    for name in kept:
        across = tiled(pictures[name], wraps[name][0], axes[0], 1)
        maps[name] = tiled(across, wraps[name][1], axes[1], 0)
    moved = (uv - [axes[0].first, axes[1].first]) / [axes[0].count, axes[1].count]
    near, all_near = repeated_near_zero(moved)
    if not (same and all_near):
        lost.append("textures far outside of [0, 1]: some look otherwise there")
    return Sampled(maps=maps, uv=near.astype(np.float32))


def _picture(
    document: GltfDocument, info: dict[str, Any], is_encoded: bool, lost: list[str]
) -> Map | None:
    """Return a texture's picture [H, W, 4], linear; None, with a note, where there is none."""
    texture = document.tree["textures"][info["index"]]
    if "source" not in texture:
        lost.append("textures in a form of picture that is not read (KHR_texture_basisu, WebP)")
        return None
    image = texture["source"]
    data = document.picture_bytes(image)
    name = f"{document.name}: image {image}"
    pixels = decoded_pixels(data, name, lost) if data else None
    if pixels is None:
        lost.append(f"image {image}: missing or not readable as a picture")
        return None
    coded: NDArray = pixels[::-1]
    plain = linear = np.clip(np.nan_to_num(coded, nan=0.0), 0, 1)
    if coded.dtype == np.uint8:
        plain = coded.astype(np.float32) / np.float32(255)
        linear = linear_from_srgb8()[coded] if is_encoded else plain
    whole = np.ones((*coded.shape[:2], 4), np.float32)
    count = coded.shape[2]
    whole[..., :3] = linear[..., :3] if count >= 3 else linear[..., :1]
    if count == 4:
        whole[..., 3] = plain[..., 3]
    return whole


Chart = tuple[int, tuple[float, float], float, tuple[float, float]]
"""Number of the set of coordinates; offset, rotation in radians and scale of what is read there."""


def _chart(info: dict[str, Any]) -> Chart:
    moved = extension(info, "KHR_texture_transform")
    number = int(moved.get("texCoord", info.get("texCoord", 0)))
    offset, scale = (
        cast("tuple[float, float]", tuple(float(x) for x in moved.get(name, default))[:2])
        for name, default in (("offset", (0, 0)), ("scale", (1, 1)))
    )
    return number, offset, float(moved.get("rotation", 0)), scale


def _placed(uv: NDArray[np.float32] | None, chart: Chart) -> NDArray[np.float64] | None:
    """Return coordinates after a texture's transform, with v up.

    A positive rotation turns coordinates counter-clockwise as the picture is seen: v goes down.
    """
    if uv is None:
        return None
    _, offset, rotation, scale = chart
    u, v = np.moveaxis(uv.astype(np.float64) * scale, -1, 0)
    cos, sin = np.cos(rotation), np.sin(rotation)
    right, down = cos * u + sin * v + offset[0], cos * v - sin * u + offset[1]
    return np.stack([right, 1 - down], axis=-1)


def _wraps(document: GltfDocument, info: dict[str, Any]) -> tuple[Wrap, Wrap]:
    texture = document.tree["textures"][info["index"]]
    samplers = document.tree.get("samplers", ())
    sampler = samplers[texture["sampler"]] if "sampler" in texture else {}
    across, up = (_WRAPS.get(sampler.get(name, 10497), "repeat") for name in ("wrapS", "wrapT"))
    return cast("tuple[Wrap, Wrap]", (across, up))
