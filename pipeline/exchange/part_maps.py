"""Samples the pictures of a material as linear maps over the coordinates of a mesh.

A material has one set of coordinates here: that of its first picture. A picture with another set
becomes its mean.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.linear_maps import Map, constant_map
from pipeline.exchange.wrapping import choose_tiles, expand_tiles, shift_near_zero
from pipeline.foreign.material import Slot
from pipeline.foreign.part import Part

SLOTS: Mapping[str, str] = {
    "base": "base",
    "metallic": "metallic_map",
    "roughness": "roughness_map",
    "specular_colour": "specular_colour",
    "specular_strength": "specular_strength_map",
    "glossiness": "glossiness",
}
"""Slot of `SourceMaterial` for each field of `MaterialSamples`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SampledMaps:
    """Linear maps of a material's pictures, and the coordinates of a mesh in them."""

    maps: Mapping[str, Map]
    """[H, W, 4] linear values by the field of `MaterialSamples`, the bottom row first."""
    uv: NDArray[np.float32] | None
    """[T, 3, 2] coordinates in the maps; None where all maps are constants."""


def sample_slots(part: Part, lost: list[str]) -> SampledMaps:
    """Return the maps of a part's material; its first picture decides on the coordinates.

    `lost` receives a sentence for each loss.
    """
    stated = {name: getattr(part.material, field) for name, field in SLOTS.items()}
    slots: dict[str, Slot] = {name: slot for name, slot in stated.items() if slot is not None}
    pictures = {name: slot.picture.linear(slot.picture.values) for name, slot in slots.items()}
    first = next(iter(slots.values()), None)
    plain = None if first is None else part.coordinates(first.uv_set)
    uv = None if first is None or plain is None else plain @ first.uv_matrix.T + first.uv_offset
    if slots and uv is None:
        lost.append(
            f"{part.where}textures of a mesh without texture coordinates: replaced by their means"
        )
    same_chart = [
        name
        for name, slot in slots.items()
        if first and uv is not None and _chart(slot) == _chart(first)
    ]
    if uv is not None and len(same_chart) < len(slots):
        lost.append(
            f"{part.where}textures with other coordinates than the first of a material: replaced "
            "by means"
        )
    maps = {name: constant_map(picture.mean(axis=(0, 1))) for name, picture in pictures.items()}
    if uv is None:
        return SampledMaps(maps=maps, uv=None)
    tiles_by_axis = []
    is_exact = True
    for axis in range(2):
        texels = max(pictures[name].shape[1 - axis] for name in same_chart)
        wraps = [slots[name].picture.wrap[axis] for name in same_chart]
        tiles, fits = choose_tiles(wraps, uv[..., axis], texels)
        tiles_by_axis.append(tiles)
        is_exact &= fits
    for name in same_chart:
        wrap = slots[name].picture.wrap
        across = expand_tiles(pictures[name], wrap[0], tiles_by_axis[0], 1)
        maps[name] = expand_tiles(across, wrap[1], tiles_by_axis[1], 0)
    moved = (uv - [tiles_by_axis[0].first, tiles_by_axis[1].first]) / [
        tiles_by_axis[0].count,
        tiles_by_axis[1].count,
    ]
    near, all_near = shift_near_zero(moved)
    if not (is_exact and all_near):
        lost.append(
            f"{part.where}coordinates far outside [0, 1]: some textures look different there"
        )
    return SampledMaps(maps=maps, uv=near.astype(np.float32))


def _chart(slot: Slot) -> tuple[int, bytes, bytes]:
    """Return a key that is equal for pictures with the same coordinates."""
    return (slot.uv_set, slot.uv_matrix.tobytes(), slot.uv_offset.tobytes())
