"""Samples the pictures of a material as linear maps over the coordinates of a mesh.

A material has one set of coordinates here: that of its first picture. A picture with another set
becomes its mean. Textures of a scene repeat along u and v; those of other formats may be mirrored
in every second tile, or continue as their border or as black. Over the finitely many tiles that a
mesh uses, each equals one picture: the tiles side by side, looked up at coordinates shifted and
scaled to [0, 1].
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.linear_maps import Map, constant_map
from pipeline.foreign.material import Slot
from pipeline.foreign.part import Part
from pipeline.foreign.picture import Picture, Wrap
from storage.records.exr import MAX_RESOLUTION
from storage.records.scene_maps import MAX_UV

_SLOTS: Mapping[str, str] = {
    "base": "base",
    "metallic": "metallic_map",
    "roughness": "roughness_map",
    "specular_colour": "specular_colour",
    "specular_strength": "specular_strength_map",
    "glossiness": "glossiness",
}
"""Slot of `SourceMaterial` for each field of `MaterialSamples`."""


_MAX_TILES = 8
"""Maximum number of tiles along a side."""

_INSIDE = 1e-4
"""Tolerance for coordinates that leave [0, 1] by rounding."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedSlots:
    """Pictures of a material, and the coordinates of a mesh in their maps."""

    slots: Mapping[str, Slot]
    """Slots by the field of `MaterialSamples`."""
    same_chart: Sequence[str]
    """Names of the slots whose maps vary over the mesh; others are their means."""
    tiles: tuple[range, range] | None
    """Tiles of these maps along u and v, tile 0 is [0, 1]; None where all maps are constants."""
    uv: NDArray[np.float32] | None
    """[T, 3, 2] coordinates in the maps; None where all maps are constants."""

    @property
    def texels(self) -> int:
        """Return the number of texels of the largest map."""
        shapes = [self.slots[name].picture.values.shape for name in self.same_chart]
        tiles = 1 if self.tiles is None else len(self.tiles[0]) * len(self.tiles[1])
        return max((shape[0] * shape[1] * tiles for shape in shapes), default=1)

    def build_maps(self) -> dict[str, Map]:
        """Return linear maps [H, W, 4] by the names of slots, the bottom row first."""
        maps = {}
        for name, slot in self.slots.items():
            values = slot.picture.linear(slot.picture.values)
            if self.tiles is None or name not in self.same_chart:
                maps[name] = constant_map(values.mean(axis=(0, 1)))
                continue
            across = _expand_tiles(values, slot.picture.wrap[0], self.tiles[0], 1)
            maps[name] = _expand_tiles(across, slot.picture.wrap[1], self.tiles[1], 0)
        return maps


def place_slots(part: Part, lost: list[str]) -> PlacedSlots:
    """Return the pictures of a part's material; the first one decides on the coordinates.

    `lost` receives a sentence for each loss.
    """
    stated = {name: getattr(part.material, field) for name, field in _SLOTS.items()}
    slots: dict[str, Slot] = {name: slot for name, slot in stated.items() if slot is not None}
    first = next(iter(slots.values()), None)
    plain = None if first is None else part.coordinates(first.uv_set)
    if first is None or plain is None:
        if slots:
            lost.append(
                f"{part.where}textures of a mesh without texture coordinates: replaced by their "
                "means"
            )
        return PlacedSlots(slots=slots, same_chart=(), tiles=None, uv=None)
    uv = plain @ first.uv_matrix.T + first.uv_offset
    same_chart = [name for name, slot in slots.items() if _chart(slot) == _chart(first)]
    if len(same_chart) < len(slots):
        lost.append(
            f"{part.where}textures with other coordinates than the first of a material: replaced "
            "by means"
        )
    pictures = [slots[name].picture for name in same_chart]
    (across, all_across), (up, all_up) = (
        _choose_tiles(pictures, uv[..., axis], axis) for axis in range(2)
    )
    moved = (uv - [across.start, up.start]) / [len(across), len(up)]
    near, all_near = _shift_near_zero(moved)
    if not (all_across and all_up and all_near):
        lost.append(
            f"{part.where}coordinates far outside [0, 1]: some textures look different there"
        )
    return PlacedSlots(
        slots=slots, same_chart=same_chart, tiles=(across, up), uv=near.astype(np.float32)
    )


def _chart(slot: Slot) -> tuple[int, bytes, bytes]:
    """Return a key that is equal for pictures with the same coordinates."""
    return (slot.uv_set, slot.uv_matrix.tobytes(), slot.uv_offset.tobytes())


def _choose_tiles(
    pictures: Sequence[Picture], at: NDArray[np.floating], axis: int
) -> tuple[range, bool]:
    """Return the tiles of one material's pictures along an axis, and whether they suffice.

    One tile where all pictures repeat, no coordinate leaves [0, 1], or too many would be needed.
    `at` has the coordinates of all corners along the axis, 0 for u and 1 for v.
    """
    most_texels = max(picture.values.shape[1 - axis] for picture in pictures)
    low, high = (float(at.min()), float(at.max())) if at.size else (0.0, 1.0)
    modes = {picture.wrap[axis] for picture in pictures} - {"repeat"}
    if not modes or (low >= -_INSIDE and high <= 1 + _INSIDE):
        needed = range(1)
    elif modes == {"mirror"}:
        needed = range(2)
    else:
        needed = range(int(np.floor(low)), int(np.ceil(high)))
    if len(needed) <= _MAX_TILES and len(needed) * most_texels <= MAX_RESOLUTION:
        return needed, True
    return range(1), len(needed) == 1


def _expand_tiles(values: NDArray, wrap: Wrap, tiles: range, axis: int) -> NDArray:
    """Return the tiles of a picture [H, W, C] side by side along axis 0 (v) or 1 (u)."""
    tile_values = [_tile(values, wrap, number, axis) for number in tiles]
    return np.concatenate(tile_values, axis=axis) if len(tile_values) > 1 else tile_values[0]


def _shift_near_zero(uv: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool]:
    """Return coordinates [T, 3, 2] within MAX_UV, and whether they look up the same texels.

    A triangle far out is shifted by whole periods of the texture.
    """
    if not uv.size or np.abs(uv).max() <= MAX_UV:
        return uv, True
    near = uv - np.floor(uv.min(axis=1, keepdims=True))
    return np.clip(near, -MAX_UV, MAX_UV), bool(near.max() <= MAX_UV)


def _tile(values: NDArray, wrap: Wrap, number: int, axis: int) -> NDArray:
    if wrap == "repeat" or number == 0:
        return values
    if wrap == "mirror":
        return np.flip(values, axis) if number % 2 else values
    if wrap == "black":
        return np.zeros_like(values)
    border = np.take(values, [0 if number < 0 else values.shape[axis] - 1], axis)
    return np.repeat(border, values.shape[axis], axis)
