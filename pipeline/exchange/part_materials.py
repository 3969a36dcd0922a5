"""`Part`, triangles with one material, of any format, and their textures and material rows.

Other formats reflect more at grazing angles, by Schlick's curve; a scene's material reflects the
mean of that curve at all angles (pipeline.foreign.material).

A material has one set of coordinates here: that of its first picture. A picture with another set
becomes its mean. Textures of a scene repeat along u and v; those of other formats may be mirrored
in every second tile, or continue as their border or as black. Over the finitely many tiles that a
mesh uses, each equals one picture: the tiles side by side, looked up at coordinates shifted and
scaled to [0, 1].
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.textured_triangles import (
    MAP_ROWS,
    NO_TEXTURES,
    Map,
    TexturedTriangles,
    TextureSet,
    color_textures,
    constant_map,
    number_texture,
    resample_to_largest,
)
from pipeline.foreign.material import Slot, SourceMaterial, source_columns
from pipeline.foreign.picture import Picture, Wrap, spread_points
from pipeline.scenes.shading_normals import SMALLEST_DOUBLE_AREA
from storage.conventions import srgb8
from storage.records.exr import MAX_RESOLUTION
from storage.records.material import EMISSION, REFLECTING, default_rows
from storage.records.scene import MAX_UV
from storage.records.texture import MapSource


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """Triangles with one material, each with three separate corners."""

    where: str
    """Beginning of notes, such as the path of a mesh with a colon; may be empty."""
    material: SourceMaterial
    """Material of every triangle, as the file states it."""
    positions: NDArray[np.float32]
    """[T, 3, 3] corners in world space; every triangle has an area."""
    normals: NDArray[np.float32]
    """[T, 3, 3] unit normals at the corners."""
    coordinates: Callable[[int], NDArray[np.float64] | None]
    """Returns a set of texture coordinates [T, 3, 2], v up; None where it is missing."""
    colors: NDArray[np.float64] | None
    """[T, 3, 3] linear tints of the corners, multiplied with the base color; None for white."""


def drop_empty(
    corners: NDArray[np.float64],
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_]]:
    """Return triangles [T, 3, 3] that have an area, their unit normals [T, 3], and a mask of them.

    In a mesh smaller than a meter the least area shrinks with its size: triangles of a watch are
    small.
    """
    positions = corners.astype(np.float32)
    wide = positions.astype(np.float64)
    cross = np.cross(wide[:, 1] - wide[:, 0], wide[:, 2] - wide[:, 0])
    size = min(float(np.ptp(wide.reshape(-1, 3), axis=0).max()), 1.0) if wide.size else 1.0
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    has_area: NDArray[np.bool_] = length[:, 0] > SMALLEST_DOUBLE_AREA * size**2
    return positions[has_area], cross[has_area] / length[has_area], has_area


def unit_normals(
    stated: NDArray[np.float64] | None, flat: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Return unit normals [T, 3, 3] at corners; `flat` [T, 3] where none of a length is stated."""
    if stated is None:
        return np.repeat(flat[:, None], 3, axis=1).astype(np.float32)
    length = np.linalg.norm(stated, axis=2, keepdims=True)
    usable = np.isfinite(length) & (length > 0)
    unit = np.where(usable, stated / np.where(usable, length, 1), flat[:, None])
    return np.asarray(unit, np.float32)


_MAX_TILES = 8
"""Maximum number of tiles along a side."""

_INSIDE = 1e-4
"""Tolerance for coordinates that leave [0, 1] by rounding."""

_TRIANGLES = 4096
"""Number of triangles whose emission is sampled at a time."""

_MOST_TINTS = 256
"""Maximum number of vertex colors that become separate materials; more become a texture."""

_MOST_TINTED = 1 << 25
"""Maximum texels of all textures of a mesh that differ in vertex color alone."""

_ROUGH = ("roughness", "glossiness")


class PartConverter:
    """Converts parts to triangles with textures, which parts of one material share."""

    def __init__(self, lost: list[str]) -> None:
        """Keep `lost`, which receives a sentence for each loss."""
        self._lost = lost
        self._textures: dict[tuple[object, ...], TextureSet] = {}
        self._means: dict[int, Mapping[str, Map]] = {}

    def convert(self, part: Part, source: MapSource) -> TexturedTriangles:
        """Return the triangles of a part with the textures and rows of its material.

        Parts whose material is the same object share textures, which get the name and rights of
        `source`.
        """
        count = len(part.positions)
        placed = _PlacedSlots(part, self._lost)
        uv = placed.uv
        most = _MOST_TINTED
        if uv is not None:
            most = min(max(_MOST_TINTED // placed.texels, 1), _MOST_TINTS)
        tints, tint_index = _tints(part, most, self._lost)
        rows = default_rows(count)
        rows[:, EMISSION] = _emission(part, self._lost)
        texture_sets: Sequence[TextureSet] = (NO_TEXTURES,)
        if uv is not None:
            keys = [(id(part.material), placed.tiles, source, tint.tobytes()) for tint in tints]
            if not self._textures.keys() >= set(keys):
                maps = placed.build_maps()
                for key, tint in zip(keys, tints, strict=True):
                    self._textures[key] = _textures(part.material, maps, tint, source)
            texture_sets = [self._textures[key] for key in keys]
        else:
            if id(part.material) not in self._means:
                self._means[id(part.material)] = placed.build_maps()
            means = self._means[id(part.material)]
            if len(tints) > _MOST_TINTS:
                means, uv = _build_palette(means, tints, tint_index)
                texture_sets = [_textures(part.material, means, np.ones(3), source)]
            else:
                columns = _columns(part.material, means, np.asarray(tints)[None])
                rows[:, REFLECTING] = columns[0, tint_index]
        return TexturedTriangles(
            positions=part.positions,
            normals=part.normals,
            rows=rows,
            uv=np.zeros((count, 3, 2), np.float32) if uv is None else uv,
            texture_set_index=tint_index % len(texture_sets),
            texture_sets=texture_sets,
        )


def _textures(
    material: SourceMaterial, maps: Mapping[str, Map], tint: NDArray[np.float64], source: MapSource
) -> TextureSet:
    """Return the textures of a material whose base color is multiplied by a tint [3]."""
    colored = {name: values for name, values in maps.items() if name not in _ROUGH}
    rough = {name: values for name, values in maps.items() if name in _ROUGH}
    values = _columns(material, colored, tint[None, None])
    roughness = _columns(material, rough, np.ones((1, 1, 3)))[..., 6:]
    diffuse, specular = color_textures(
        _collapse_constant(values[..., :3]), _collapse_constant(values[..., 3:6]), source
    )
    return diffuse, specular, number_texture(_collapse_constant(roughness), source)


def _columns(
    material: SourceMaterial, maps: Mapping[str, Map], tint: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Return the columns [H, W, 7] of a material whose base is multiplied by a tint [., ., 3]."""
    resampled = dict(zip(maps, resample_to_largest(*maps.values()), strict=True))
    height, width = np.broadcast_shapes(
        tint.shape[:2], *(map_.shape[:2] for map_ in resampled.values())
    )
    values = np.zeros((height, width, 7), np.float32)
    for first in range(0, height, MAP_ROWS):
        size = min(MAP_ROWS, height - first)
        texel_values = {
            name: _flatten_on_grid(
                map_[first : first + size] if len(map_) > 1 else map_, size, width
            )
            for name, map_ in resampled.items()
        }
        colors = _flatten_on_grid(tint, size, width)
        texel_values["base"] = (
            texel_values["base"][:, :3] * colors if "base" in texel_values else colors
        )
        rows = source_columns(material, texel_values, size * width, least_roughness=0)
        values[first : first + size] = rows.reshape(size, width, 7)
    return values


def _flatten_on_grid(values: NDArray, height: int, width: int) -> NDArray:
    """Return the values [N, C] of a map at each texel of a grid."""
    return np.broadcast_to(values, (height, width, values.shape[2])).reshape(-1, values.shape[2])


def _collapse_constant(values: NDArray[np.float32]) -> Map:
    """Return a map of one texel where all texels are equal."""
    return values[:1, :1] if (values == values[0, 0]).all() else values


def _tints(part: Part, most: int, lost: list[str]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return at most `most` colors [K, 3], and the index [T] of the color of each triangle."""
    colors = part.colors
    if colors is None or not len(colors):
        return np.ones((1, 3)), np.zeros(len(part.positions), np.int64)
    if np.ptp(colors, axis=1).max() > 1 / 255:
        lost.append(f"{part.where}colors of vertices: replaced by the mean of each triangle")
    plain = np.clip(np.nan_to_num(colors.mean(axis=1)), 0, 1)
    tints, tint_index = _group_colors(plain, np.round(plain * 1e6).astype(np.int64))
    coded = srgb8(plain).astype(np.int64)
    shift = 0
    while len(tints) > most:
        tints, tint_index = _group_colors(plain, coded >> shift)
        shift += 1
    if shift:
        lost.append(f"{part.where}colors of vertices over textures: rounded to a few")
    return tints, tint_index


def _group_colors(
    colors: NDArray[np.float64], codes: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Group colors by equal codes [T, 3]; return group means [K, 3] and indices [T]."""
    keys = codes @ np.array([1 << 42, 1 << 21, 1])
    _, group_index, counts = np.unique(keys, return_inverse=True, return_counts=True)
    sums = [np.bincount(group_index, colors[:, channel]) for channel in range(3)]
    return np.stack(sums, axis=1) / counts[:, None], group_index.astype(np.int64)


def _build_palette(
    means: Mapping[str, Map], tints: NDArray[np.float64], tint_index: NDArray[np.int64]
) -> tuple[dict[str, Map], NDArray[np.float32]]:
    """Return maps with one texel for each of many colors, and coordinates [T, 3, 2] of these."""
    side = int(np.ceil(np.sqrt(len(tints))))
    texels = np.ones((side * side, 4), np.float32)
    texels[: len(tints), :3] = tints
    base = means.get("base", constant_map([1, 1, 1, 1])) * texels.reshape(side, side, 4)
    centers = (np.stack([tint_index % side, tint_index // side], axis=1) + 0.5) / side
    return {**means, "base": base}, np.repeat(centers[:, None], 3, axis=1).astype(np.float32)


def _emission(part: Part, lost: list[str]) -> NDArray[np.float64]:
    """Return the radiance [T, 3] of triangles; a texture counts by its mean over each."""
    radiance = np.tile(part.material.emission_rgb, (len(part.positions), 1))
    slot = part.material.emission
    if slot is None or not part.material.emits:
        return radiance
    lost.append(f"{part.where}textures of emission: one value for each triangle")
    picture = slot.picture
    uv = part.coordinates(slot.uv_set)
    if uv is None:
        return radiance * picture.linear(picture.values).mean(axis=(0, 1))[:3]
    for first in range(0, len(uv), _TRIANGLES):
        corners = uv[first : first + _TRIANGLES] @ slot.uv_matrix.T + slot.uv_offset
        points = np.einsum("pk,tkc->tpc", spread_points(), corners)
        flat = points.reshape(-1, 2)
        values = picture.sample(flat, np.zeros(len(flat), np.int64)).reshape(*points.shape[:2], 4)
        radiance[first : first + _TRIANGLES] *= values.mean(axis=1)[:, :3]
    return radiance


class _PlacedSlots:
    """Pictures of a part's material by slot, and the coordinates of the part in their maps.

    The first picture decides on the coordinates; those with others become their means. `tiles` are
    those of the maps along u and v, tile 0 is [0, 1]. They and the coordinates `uv` [T, 3, 2] are
    None where all maps are constants.
    """

    tiles: tuple[range, range] | None = None
    uv: NDArray[np.float32] | None = None

    def __init__(self, part: Part, lost: list[str]) -> None:
        """Place the pictures; `lost` receives a sentence for each loss."""
        self._slots = part.material.column_slots
        self._same_chart: list[str] = []
        first = next(iter(self._slots.values()), None)
        plain = None if first is None else part.coordinates(first.uv_set)
        if first is None or plain is None:
            if self._slots:
                lost.append(
                    f"{part.where}textures of a mesh without texture coordinates: replaced by "
                    "their means"
                )
            return
        uv = plain @ first.uv_matrix.T + first.uv_offset
        self._same_chart += [name for name, s in self._slots.items() if _chart(s) == _chart(first)]
        if len(self._same_chart) < len(self._slots):
            lost.append(
                f"{part.where}textures with other coordinates than the first of a material: "
                "replaced by means"
            )
        pictures = [self._slots[name].picture for name in self._same_chart]
        (across, all_across), (up, all_up) = (
            _choose_tiles(pictures, uv[..., axis], axis) for axis in range(2)
        )
        moved = (uv - [across.start, up.start]) / [len(across), len(up)]
        near, all_near = _shift_near_zero(moved)
        if not (all_across and all_up and all_near):
            lost.append(
                f"{part.where}coordinates far outside [0, 1]: some textures look different there"
            )
        self.tiles = (across, up)
        self.uv = near.astype(np.float32)

    @property
    def texels(self) -> int:
        """Return the number of texels of the largest map."""
        shapes = [self._slots[name].picture.values.shape for name in self._same_chart]
        tiles = 1 if self.tiles is None else len(self.tiles[0]) * len(self.tiles[1])
        return max((shape[0] * shape[1] * tiles for shape in shapes), default=1)

    def build_maps(self) -> dict[str, Map]:
        """Return linear maps [H, W, 4] by the names of slots, the bottom row first."""
        maps = {}
        for name, slot in self._slots.items():
            values = slot.picture.linear(slot.picture.values)
            if self.tiles is None or name not in self._same_chart:
                maps[name] = constant_map(values.mean(axis=(0, 1)))
                continue
            across = _expand_tiles(values, slot.picture.wrap[0], self.tiles[0], 1)
            maps[name] = _expand_tiles(across, slot.picture.wrap[1], self.tiles[1], 0)
        return maps


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
        tiles = range(1)
    elif modes == {"mirror"}:
        tiles = range(2)
    else:
        tiles = range(int(np.floor(low)), int(np.ceil(high)))
    if len(tiles) <= _MAX_TILES and len(tiles) * most_texels <= MAX_RESOLUTION:
        return tiles, True
    return range(1), len(tiles) == 1


def _expand_tiles(values: NDArray, wrap: Wrap, tiles: range, axis: int) -> NDArray:
    """Return the tiles of a picture [H, W, C] side by side along axis 0 (v) or 1 (u)."""
    size = values.shape[axis]
    if wrap == "repeat" or tiles == range(1):
        return np.concatenate([values] * len(tiles), axis=axis)
    texels = np.arange(tiles.start * size, tiles.stop * size)
    rows = np.clip(texels, 0, size - 1)
    if wrap == "mirror":
        rows = np.where(texels // size % 2, -1 - texels, texels) % size
    expanded: NDArray = np.take(values, rows, axis)
    if wrap == "black":
        outside = np.expand_dims(rows != texels, (1 - axis, 2))
        expanded = np.where(outside, expanded.dtype.type(0), expanded)
    return expanded


def _shift_near_zero(uv: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool]:
    """Return coordinates [T, 3, 2] within MAX_UV, and whether they look up the same texels.

    A triangle far out is shifted by whole periods of the texture.
    """
    if not uv.size or np.abs(uv).max() <= MAX_UV:
        return uv, True
    near = uv - np.floor(uv.min(axis=1, keepdims=True))
    return np.clip(near, -MAX_UV, MAX_UV), bool(near.max() <= MAX_UV)
