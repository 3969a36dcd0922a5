"""`DevicePictures`: the arithmetic of a view as kernels, where its samples are traced.

What is read back are a few numbers of each tile at each look, and the pictures once. Pictures are
Color3f, what is worked out of them is Float64, pixel by pixel.
"""

import ctypes
import operator
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.device_memory import KernelInputs, read_back, record_launches
from pipeline.renders.pictures import (
    TILE,
    Sums,
    ViewPictures,
    broken_pixels,
    finish_pictures,
    half_means,
    measure_pixels,
    raws_to_filter,
)
from pipeline.renders.samples import TILE_PX, DualBuffer
from pipeline.renders.tracer import PixelCamera
from pipeline.renders.vector_tracer import VectorTracer
from pipeline.renders.view_pictures import (
    GLINT,
    MOST_APART,
    Pixels,
    add_up,
    require_finite,
)
from storage.denoiser import INPUTS, Quality, open_filter

_INV_LN_10 = 0.4342944819032518


class KernelPixels(Pixels):
    """Operations on Dr.Jit's arrays of the pixels of a picture.

    Sums are taken over tiles of 64 pixels, then over rows of tiles: in their own order, but always
    the same one.
    """

    select: Any = staticmethod(dr.select)
    sqrt: Any = staticmethod(dr.sqrt)
    maximum: Any = staticmethod(dr.maximum)
    brightest: Any = staticmethod(dr.max)
    channels: Any = staticmethod(list)
    flat: Any = staticmethod(dr.ravel)
    mean: Any = staticmethod(operator.truediv)

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

    def channel_mean(self, color: Any) -> Any:
        return channel_sum(color) / 3

    def is_finite(self, color: Any) -> Any:
        return dr.all(dr.isfinite(color))

    def difference(self, first: Any, second: Any) -> Any:
        return mi.Color3d(first) - mi.Color3d(second)

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

    def tile_sums(self, values: Sequence[Any]) -> Sequence[Any]:
        count = self._resolution**2 // TILE
        tiles = self.reduce_tiles(values, dr.ReduceOp.Add)
        tile = dr.arange(mi.UInt32, count)
        return [dr.gather(mi.Float64, tiles, tile + row * count) for row in range(len(values))]

    def totals_of_tiles(self, values: Sequence[Any]) -> Any:
        across = self._resolution // TILE_PX
        return dr.block_sum(dr.block_sum(dr.concat(list(values)), across), across)

    def one_row(
        self, totals: Sequence[Any], adds: Sequence[Any], most: Sequence[Any], logs: Sequence[Any]
    ) -> Any:
        dr.eval(logs)
        added = self.reduce_tiles(adds, dr.ReduceOp.Add)
        return dr.concat([*totals, added, self.reduce_tiles(most, dr.ReduceOp.Max)])

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


def _sums(samples: DualBuffer) -> Sums:
    return [[each.sums for each in half] for half in samples.sums]


class DevicePictures(ViewPictures):
    """See `ViewPictures` for the meaning of its methods."""

    _inputs = KernelInputs
    _read = staticmethod(_sums)
    _raws = staticmethod(record_launches(raws_to_filter))
    _finish = staticmethod(record_launches(finish_pictures))
    _measure = staticmethod(record_launches(measure_pixels))

    def _trace_guides(
        self, tracer: VectorTracer, camera: PixelCamera
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        self._resolution = camera.resolution
        self._pixels = KernelPixels(camera.resolution)
        self._guides = tracer.guides(camera, self._names, spp=self._settings.aux_spp)
        self._hit = tracer.hit_array(camera)
        self._logs = [dr.opaque(mi.Color3d, 0, camera.resolution**2) for _ in range(2)]
        visible = dr.any(dr.unravel(mi.Color3f, self._guides[""][1]) != 0)
        byte: Any = mi.UInt8
        bits = read_back(byte(dr.select(self._hit, 1, 0) + dr.select(visible, 2, 0)))
        bits = bits.reshape(camera.resolution, camera.resolution)
        return bits & 1 > 0, bits & 2 > 0

    @staticmethod
    def mean_radiance(samples: DualBuffer) -> float:
        resolution = samples.spp_by_half.shape[-1]
        inputs = KernelInputs(KernelPixels(resolution))
        total, broken = read_back(_brightness(inputs, _sums(samples)))
        require_finite(int(broken))
        return float(total) / (3 * resolution**2)

    def finish(self) -> NDArray[np.float32]:
        shape = (-1, self._resolution, self._resolution, 3)
        return np.reshape([read_back(picture) for picture in self._make_pictures()], shape)

    def _denoise(self, raws: Sequence[Any], guides: Sequence[Any], quality: Quality) -> list[Any]:
        return denoise_arrays(raws, guides, self._resolution, quality)


@record_launches
def _brightness(pixels: KernelPixels, sums: Sums) -> Any:
    """Return the sum of all channels of the mean of both halves, and the broken pixels."""
    of_halves = [add_up(half) for half in half_means(sums, pixels)]
    return pixels.totals([channel_sum(add_up(of_halves)) / 2, broken_pixels(sums, pixels)])


def denoise_arrays(
    pictures: Sequence[Any], guides: Sequence[tuple[Any, Any]], resolution: int, quality: Quality
) -> list[Any]:
    """Return what the filter makes of pictures in Dr.Jit's memory, where it runs on that.

    Args:
        pictures: [3 R^2] mi.Float, pixel by pixel.
        guides: albedo and normal of each.
    """
    opened = open_filter(resolution, quality)
    if (dr.backend_v(pictures[0]) == dr.JitBackend.CUDA) != opened.is_on_gpu:
        kind = type(pictures[0])
        shape = (resolution, resolution, 3)
        inputs = [
            [np.array(each).reshape(shape) for each in (p, *g)]
            for p, g in zip(pictures, guides, strict=True)
        ]
        return [kind(opened.run(dict(zip(INPUTS, each, strict=True))).ravel()) for each in inputs]
    outputs = [dr.opaque(type(picture), 0, len(picture)) for picture in pictures]
    dr.eval(pictures, guides)
    dr.sync_thread()
    for picture, (albedo, normal), output in zip(pictures, guides, outputs, strict=True):
        arrays = {"color": picture, "albedo": albedo, "normal": normal, "output": output}
        opened.run_in_place({name: _address(array) for name, array in arrays.items()})
    return outputs


_capsule_pointer = ctypes.pythonapi.PyCapsule_GetPointer
_capsule_pointer.restype = ctypes.c_void_p
_capsule_pointer.argtypes = [ctypes.py_object, ctypes.c_char_p]


def _address(array: Any) -> int:
    """Return where an evaluated array of Dr.Jit is, in the memory of its device.

    In DLPack's structure `DLTensor` the first eight bytes are `data`, the sixth are `byte_offset`.
    """
    capsule = array.__dlpack__()
    words = (ctypes.c_uint64 * 6).from_address(_capsule_pointer(capsule, b"dltensor"))
    return int(words[0]) + int(words[5])
