"""The pixels of a view as kernels: sums over tiles and over all, in the memory of the device.

Sums are taken over tiles of 64 pixels, then over rows of tiles: in their own order, but always the
same one. Pictures are Color3f, what is worked out of them is Float64, pixel by pixel.
"""

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from pipeline.renders.pictures import TILE
from pipeline.renders.pixels import Pixels
from pipeline.renders.samples import TILE_PX
from pipeline.renders.view_pictures import GLINT, MOST_APART, add_up

_INV_LN_10 = 0.4342944819032518


class KernelPixels(Pixels):
    """`Pixels` of a width, of Dr.Jit's arrays."""

    select: Any = staticmethod(dr.select)
    sqrt: Any = staticmethod(dr.sqrt)
    maximum: Any = staticmethod(dr.maximum)

    def __init__(self, resolution: int) -> None:
        self._resolution = resolution

    def single(self, color: Any) -> Any:
        return mi.Color3f(color)

    def double(self, color: Any) -> Any:
        return mi.Color3d(color)

    def log10(self, radiance: Any) -> Any:
        return dr.log(1 + radiance) * _INV_LN_10

    def clamp(self, radiance: Any) -> Any:
        return dr.clip(radiance, 0, 1)

    def channels(self, color: Any) -> Sequence[Any]:
        return list(color)

    def channel_mean(self, color: Any) -> Any:
        return channel_sum(color) / 3

    def brightest(self, color: Any) -> Any:
        return dr.max(color)

    def is_finite(self, color: Any) -> Any:
        return dr.all(dr.isfinite(color))

    def mean(self, total: Any, count: Any) -> Any:
        return total / count

    def difference(self, first: Any, second: Any) -> Any:
        return mi.Color3d(first) - mi.Color3d(second)

    def are_equal(self, first: Any, second: Any) -> bool:
        return False

    def error_around(self, squared_error: Any) -> Any:
        dr.eval(squared_error)  # eight neighbours of each pixel read it
        row, column = self._rows_and_columns()
        most = self._resolution - 1
        around = mi.Float64(0)
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                y = mi.UInt32(dr.clip(mi.Int32(row) + down, 0, most))
                x = mi.UInt32(dr.clip(mi.Int32(column) + right, 0, most))
                around += dr.gather(mi.Float64, squared_error, y * self._resolution + x)
        return dr.sqrt(around / 9)

    def clean(self, inputs: Any, outputs: Any, guides: Any, *, are_lights: bool) -> list[Any]:
        cleaned = []
        for output, (raw, name) in zip(outputs, inputs, strict=True):
            picture = mi.Color3f(dr.unravel(mi.Color3f, output))
            normal = dr.unravel(mi.Color3f, guides[name][1])
            covered = dr.any(normal != 0) | dr.any(raw != 0)
            cleaned.append(dr.select(covered, dr.maximum(picture, 0), 0))
        if not are_lights:
            return cleaned
        lit = self.totals([channel_sum(mi.Color3d(raw)) for raw, _ in inputs])
        return [
            dr.select(dr.gather(mi.Float64, lit, row) > 0, picture, 0)
            for row, picture in enumerate(cleaned)
        ]

    def with_means(self, pairs: Sequence[tuple[Any, Any]]) -> list[Any]:
        bright = [self.channel_mean(denoised) > GLINT for denoised, _ in pairs]
        values = [
            dr.select(part, channel_sum(mi.Color3d(picture)), 0)
            for glints, pair in zip(bright, pairs, strict=True)
            for part in (glints, ~glints)
            for picture in pair
        ]
        sums = self.totals(values)
        pictures = []
        for row, (glints, (denoised, _)) in enumerate(zip(bright, pairs, strict=True)):
            is_now, was, rest_is, rest_was = (
                dr.gather(mi.Float64, sums, 4 * row + each) for each in range(4)
            )
            factors = [_factor(is_now, was), _factor(rest_is, rest_was)]
            least = dr.minimum(*factors)
            most = dr.maximum(*factors)
            is_extreme = (least < 1 / MOST_APART) | (most > MOST_APART)
            common_factor = _factor(is_now + rest_is, was + rest_was)
            factor = dr.select(is_extreme, common_factor, dr.select(glints, *factors))
            pictures.append(mi.Color3f(mi.Color3d(denoised) * factor))
        return pictures

    def shares(self, parts: Sequence[Any]) -> list[Any]:
        total = add_up([mi.Color3d(part) for part in parts])
        equal = 1 / len(parts)
        return [mi.Color3f(dr.select(total > 0, mi.Color3d(part) / total, equal)) for part in parts]

    def tile_sums(self, values: Sequence[Any]) -> Sequence[Any]:
        count = self._resolution**2 // TILE
        tiles = self.reduce_tiles(values, dr.ReduceOp.Add)
        tile = dr.arange(mi.UInt32, count)
        return [dr.gather(mi.Float64, tiles, tile + row * count) for row in range(len(values))]

    def totals_of_tiles(self, values: Sequence[Any]) -> Any:
        across = self._resolution // TILE_PX
        return dr.block_sum(dr.block_sum(dr.concat(list(values)), across), across)

    def reduce_tiles(self, values: Sequence[Any], reduction: Any) -> Any:
        """Return values of pixels (Float64) reduced over tiles, those of one after another's."""
        row, column = self._rows_and_columns()
        tile = row // TILE_PX * (self._resolution // TILE_PX) + column // TILE_PX
        place = tile * TILE + row % TILE_PX * TILE_PX + column % TILE_PX
        packed = dr.zeros(mi.Float64, len(values) * self._resolution**2)
        for number, value in enumerate(values):
            dr.scatter(packed, mi.Float64(value), place + number * self._resolution**2)
        return dr.block_reduce(reduction, packed, TILE)

    def totals(self, values: Sequence[Any]) -> Any:
        """Return the sum over all pixels of each of some values (Float64)."""
        return self.totals_of_tiles([self.reduce_tiles(values, dr.ReduceOp.Add)])

    def _rows_and_columns(self) -> tuple[Any, Any]:
        pixel = dr.arange(mi.UInt32, self._resolution**2)
        return pixel // self._resolution, pixel % self._resolution


def _factor(is_now: Any, was: Any) -> Any:
    return dr.select(is_now > 0, was / is_now, 1)


def channel_sum(color: Any) -> Any:
    return color.x + color.y + color.z
