"""`DevicePictures`: the arithmetic of a view as kernels, where its samples are traced.

What is read back are a few numbers of each tile at each look, and the pictures once. The formulas
are those of pipeline.renders.noise_floor and pipeline.renders.kept_light. Sums are taken over tiles
of 64 pixels, then over rows of tiles: in an order of their own, but always the same one.
"""

import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.camera import Camera
from pipeline.renders.denoiser import denoise_arrays
from pipeline.renders.kept_light import (
    DARKER,
    GLINT,
    LEAST_PASSES,
    MOST_APART,
    STANDARD_ERRORS,
    STANDS_OUT,
)
from pipeline.renders.noise_floor import (
    BLOCK_PX,
    LINEAR_STANDARD_ERRORS,
    SMALLEST_STEP,
    MeasuredFloor,
    floor_db,
)
from pipeline.renders.recorded_calls import KernelInputs, recorded
from pipeline.renders.samples import HalfSamples
from pipeline.renders.settings import Filtered, RenderSettings
from pipeline.renders.tiles import TILE_PX, tile_means
from pipeline.renders.view_pictures import (
    Look,
    add_up,
    put_together,
    require_bounded,
    require_finite,
    to_filter,
)

assert BLOCK_PX == TILE_PX  # one order of pixels serves both
_TILE = TILE_PX * TILE_PX
_INV_LN_10 = 0.4342944819032518

Curve = Callable[[Any], Any]
"""What errors are taken in, of radiance (Color3d)."""

Sums = Sequence[Sequence[Sequence[Any]]]
"""Of each half, and in it of each tracer: `DeviceSum.sums`."""


def mean_radiance(samples: HalfSamples) -> float:
    """Return the mean radiance of all pixels so far; raises as `ViewPictures.look`."""
    resolution = len(samples.spp_of(0))
    total, broken = read_numbers(_brightness(KernelInputs(), _sums(samples), resolution))
    require_finite(int(broken))
    return float(total) / (3 * resolution**2)


def read_numbers(numbers: Any) -> NDArray:
    """Return an array of Dr.Jit as one of numpy: all that is read back of a view comes this way."""
    return np.array(numbers)


class DevicePictures:
    """See `ViewPictures` for the meaning of its methods."""

    def __init__(
        self, samples: HalfSamples, tracer: Any, camera: Camera, settings: RenderSettings
    ) -> None:
        """Trace what guides the denoiser.

        Args:
            samples: whose sums are `DeviceSum`.
            tracer: a `VectorTracer`.
            camera: the view.
            settings: how well.
        """
        self._samples, self._resolution = samples, camera.resolution
        self._names, self._quality = settings.part_names, settings.denoiser
        arrays = tracer.feature_arrays(camera, spp=settings.aux_spp)
        names = self._names or ("",)
        self._guides, masks = _guides(
            KernelInputs(), arrays, tracer.hit_array(camera), names, camera.resolution
        )
        self._logs = [dr.opaque(mi.Color3d, 0, camera.resolution**2) for _ in range(2)]
        self._masks = masks
        bits = read_numbers(masks).reshape(camera.resolution, camera.resolution)
        self.hits, self.shown = bits & 1 > 0, bits & 2 > 0
        if not self.shown.any():
            self.shown[:] = True
        hits = _TILE * tile_means(self.hits.astype(np.float64)).ravel()
        everywhere = np.full_like(hits, _TILE)
        self._counts = everywhere, everywhere, hits

    def look(self, quality: Filtered) -> Look:
        sums, kind = _sums(self._samples), (self._names, self._resolution, quality != "off")
        filtered = self._filtered(sums, quality, of_both=False)
        arrays = sums, filtered, self._guides, self._masks, self._logs
        numbers, self._logs = _measure(KernelInputs(), *arrays, *kind)
        rows = read_numbers(numbers).reshape(-1, len(self._counts[0]))
        require_finite(int(rows[2].sum()))
        require_bounded(float(rows[-1].max()))
        across = self._resolution // TILE_PX
        errors, surprises = rows[3:-1].reshape(2, -1, 3, across**2)
        floors = [self._floor(*each) for each in zip(errors, surprises, strict=True)]
        return Look(
            floor=floors[0],
            part_floors=dict(zip(self._names, floors[1:], strict=True)),
            changes=list(rows[:2].reshape(2, across, across) / _TILE),
        )

    def finish(self) -> NDArray[np.float32]:
        sums, kind = _sums(self._samples), (self._names, self._resolution, self._quality != "off")
        filtered = self._filtered(sums, self._quality, of_both=True)
        pictures = _finish(KernelInputs(), sums, filtered, self._guides, *kind)
        return read_numbers(pictures).reshape(-1, self._resolution, self._resolution, 3)

    def _floor(self, errors: NDArray[np.float64], most: NDArray[np.float64]) -> MeasuredFloor:
        """Return the floor of estimates and surprises of tiles [3, T]: log, linear, of objects."""
        deviations = 1.0, LINEAR_STANDARD_ERRORS, 1.0
        log_db, linear_db, object_log_db = (
            floor_db(error.sum() / max(count.sum(), 1), float(surprise.max()), error, count, more)
            for error, surprise, count, more in zip(
                errors, most, self._counts, deviations, strict=True
            )
        )
        return MeasuredFloor(log_db=log_db, linear_db=linear_db, object_log_db=object_log_db)

    def _filtered(self, sums: Sums, quality: Filtered, *, of_both: bool) -> list[list[Any]]:
        """Return what the denoiser makes of each half, or of the mean of both."""
        if quality == "off":
            return []
        raws = _raws(KernelInputs(), sums, self._names, of_both, self._resolution)
        pictures = range(sum(len(tracer) - 3 for tracer in sums[0]))
        names = [name for _, name in to_filter(pictures, self._names)]
        guides = [self._guides[name] for name in names]
        return [denoise_arrays(raw, guides, self._resolution, quality) for raw in raws]


def _sums(samples: HalfSamples) -> Sums:
    return [[each.sums for each in half] for half in samples.sums]  # type: ignore[attr-defined]


@recorded
def _brightness(_: Any, sums: Sums, resolution: int) -> Any:
    """Return the sum of all channels of the mean of both halves, and the broken pixels."""
    means = [add_up(half) for half in _half_means(sums)]
    return _totals([_sum(add_up(means)) / 2, _broken(sums)], resolution)


@recorded
def _guides(
    _: Any, arrays: dict[str, Any], hits: Any, names: Sequence[str], resolution: int
) -> tuple[Any, Any]:
    """Return albedo and normal by the name of a part, as `Features.of_part`, and hits and shown."""
    normal: Any = mi.Color3f(arrays["normal"])
    guides = dict[str, Any]()
    for name in names:
        albedo = mi.Color3f(arrays.get(name.partition("_")[0], arrays["albedo"]))
        seen = normal if name.partition("_")[0] not in arrays else _where_any(albedo, normal)
        guides[name] = dr.ravel(albedo), dr.ravel(seen)
    shown: Any = functools.reduce(operator.or_, normal != 0)
    byte: Any = mi.UInt8
    return guides, byte(dr.select(hits, 1, 0) + dr.select(shown, 2, 0))


@recorded
def _raws(
    _: Any, sums: Sums, names: Sequence[str], of_both: bool, resolution: int
) -> list[list[Any]]:
    """Return what the denoiser is asked for, of each half or of both (Float, pixel by pixel)."""
    return [
        [dr.ravel(picture) for picture, _ in to_filter(means, names)]
        for means in _means(sums, of_both)
    ]


@recorded
def _measure(
    _: Any,
    sums: Sums,
    filtered: list[list[Any]],
    guides: dict[str, Any],
    masks: Any,
    logs: Sequence[Any],
    names: Sequence[str],
    resolution: int,
    is_filtered: bool,
) -> tuple[Any, list[Any]]:
    """Return rows of numbers of all tiles (Float64), and the log radiance of both halves.

    The rows are sums: the changes of both halves, broken pixels, and three estimates of the picture
    and of each part; then what is greatest: surprises of the same, and the brightest raw channel.
    """
    raws = _means(sums, of_both=False)
    denoised = _denoised(raws, filtered, guides, names, resolution) if is_filtered else raws
    new_logs = [_log10(mi.Color3d(add_up(each))) for each in denoised]
    changes = [_mean(dr.square(new - old)) for new, old in zip(new_logs, logs, strict=True)]
    kept = denoised
    if is_filtered and len(sums[0]) == 1:
        picture = [[(a + b) / 2 for a, b in zip(*each, strict=True)] for each in (denoised, raws)]
        error = _squared_error_of_means(sums)
        right = _converged(picture[0], picture[1], error, resolution)
        kept = [_chosen(right, *each) for each in zip(raws, denoised, strict=True)]
    hit = (masks & 1) > 0
    rows, every = [], max(1, len(names))
    for first, step in [(0, 1), *((part, every) for part in range(len(names)))]:
        a, b, da, db = (mi.Color3d(add_up(each[first::step])) for each in (*raws, *kept))
        rows.append(_estimates(a, b, da, db, hit, is_filtered))
    brightest = functools.reduce(dr.maximum, [dr.max(part) for half in raws for part in half])
    adds = [*changes, _broken(sums), *(row for errors, _ in rows for row in errors)]
    most = [*(row for _, surprises in rows for row in surprises), brightest]
    dr.eval(new_logs)
    sums_of_tiles = _of_tiles(adds, dr.ReduceOp.Add, resolution)
    return dr.concat([sums_of_tiles, _of_tiles(most, dr.ReduceOp.Max, resolution)]), new_logs


@recorded
def _finish(
    _: Any,
    sums: Sums,
    filtered: list[list[Any]],
    guides: dict[str, Any],
    names: Sequence[str],
    resolution: int,
    is_filtered: bool,
) -> Any:
    """Return the pictures of all samples (Float), one after another."""
    raws = _means(sums, of_both=True)
    if is_filtered:
        (pictures,) = _denoised(raws, filtered, guides, names, resolution)
        if len(sums[0]) == 1:
            right = _converged(pictures, raws[0], _squared_error_of_means(sums), resolution)
            pairs = list(zip(_chosen(right, raws[0], pictures), raws[0], strict=True))
            pictures = _with_means_of(pairs, resolution)
    else:
        (pictures,) = raws
    flat: list[Any] = [dr.ravel(picture) for picture in pictures]
    return dr.concat(flat)


def _half_means(sums: Sums) -> list[list[Any]]:
    """Return the mean of each half, of each picture (Color3d)."""
    return [[total / tracer[-2] for tracer in half for total in tracer[:-3]] for half in sums]


def _means(sums: Sums, of_both: bool) -> list[list[Any]]:
    """Return the mean of each half, or of both alone, of each picture (Color3f)."""
    halves = _half_means(sums)
    if of_both:
        halves = [[(a + b) / 2 for a, b in zip(*halves, strict=True)]]
    return [[mi.Color3f(picture) for picture in half] for half in halves]


def _broken(sums: Sums) -> Any:
    """Return 1 (Float64) for pixels with a sum that is not finite, else 0."""
    totals = [total for half in sums for tracer in half for total in tracer[:-3]]
    finite = [
        dr.isfinite(total.x) & dr.isfinite(total.y) & dr.isfinite(total.z) for total in totals
    ]
    return dr.select(functools.reduce(lambda a, b: a & b, finite), mi.Float64(0), mi.Float64(1))


def _squared_error_of_means(sums: Sums) -> Any:
    """Return the square (Float64) of HostMeans.standard_error."""
    greys = [_mean(add_up(half)) for half in _half_means(sums)]
    mean = (greys[0] + greys[1]) / 2
    spread, count, shares = mi.Float64(0), mi.Float64(0), mi.Float64(0)
    for grey, (tracer,) in zip(greys, sums, strict=True):
        squares, spp, passes = tracer[-3:]
        spread += squares - spp * mean * (2 * grey - mean)
        count += passes
        shares += 1 / spp
    error = dr.maximum(spread, 0) / (count - 1) * shares / 4
    return dr.select(count < LEAST_PASSES, dr.inf, error)


def _denoised(
    raws: list[list[Any]],
    filtered: list[list[Any]],
    guides: dict[str, Any],
    names: Sequence[str],
    resolution: int,
) -> list[list[Any]]:
    """Return the pictures without noise (Color3f), from what the denoiser made of them."""
    denoised = []
    for pictures, outputs in zip(raws, filtered, strict=True):
        inputs = list(to_filter(pictures, names))
        clean = [
            _clean(mi.Color3f(dr.unravel(mi.Color3f, output)), raw, guides[name][1])
            for output, (raw, name) in zip(outputs, inputs, strict=True)
        ]
        if len(inputs) > len(names or ("",)):  # lights alone: of no light nothing is painted
            lit = _totals([_sum(mi.Color3d(raw)) for raw, _ in inputs], resolution)
            clean = [
                dr.select(dr.gather(mi.Float64, lit, row) > 0, picture, 0)
                for row, picture in enumerate(clean)
            ]
        with_means = functools.partial(_with_means_of, resolution=resolution)
        denoised.append(put_together(pictures, clean, names, with_means, _shares_of))
    return denoised


def _clean(picture: Any, raw: Any, normal: Any) -> Any:
    """Return a picture that is at least 0, and black where no ray met anything."""
    met = dr.any(dr.unravel(mi.Color3f, normal) != 0) | dr.any(raw != 0)
    return dr.select(met, dr.maximum(picture, 0), 0)


def _with_means_of(pairs: Sequence[tuple[Any, Any]], resolution: int) -> list[Any]:
    """Return pictures with the mean brightness of raw ones, as kept_light says: (denoised, raw)."""
    bright = [_mean(denoised) > GLINT for denoised, _ in pairs]
    values = [
        dr.select(part, _sum(mi.Color3d(picture)), 0)
        for glints, pair in zip(bright, pairs, strict=True)
        for part in (glints, ~glints)
        for picture in pair
    ]
    totals = _totals(values, resolution)
    pictures = []
    for row, (glints, (denoised, _)) in enumerate(zip(bright, pairs, strict=True)):
        is_now, was, rest_is, rest_was = (
            dr.gather(mi.Float64, totals, 4 * row + each) for each in range(4)
        )
        factors = [_factor(is_now, was), _factor(rest_is, rest_was)]
        least, most = dr.minimum(*factors), dr.maximum(*factors)
        apart = (least < 1 / MOST_APART) | (most > MOST_APART)
        whole = _factor(is_now + rest_is, was + rest_was)
        factor = dr.select(apart, whole, dr.select(glints, *factors))
        pictures.append(mi.Color3f(mi.Color3d(denoised) * factor))
    return pictures


def _factor(is_now: Any, was: Any) -> Any:
    return dr.select(is_now > 0, was / is_now, 1)


def _shares_of(parts: Sequence[Any]) -> list[Any]:
    """Return what share of their sum each of some pictures is: equal ones where all are 0."""
    total = add_up([mi.Color3d(part) for part in parts])
    return [
        mi.Color3f(dr.select(total > 0, mi.Color3d(part) / total, 1 / len(parts))) for part in parts
    ]


def _converged(denoised: list[Any], raw: list[Any], squared_error: Any, resolution: int) -> Any:
    """Return which pixels of the raw picture are right (Bool), as numpy's `converged`."""
    is_now, was = (_mean(mi.Color3d(add_up(parts))) for parts in (denoised, raw))
    dr.eval(squared_error)  # eight neighbours of each pixel read it
    row, column = _rows_and_columns(resolution)
    around = mi.Float64(0)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            y = mi.UInt32(dr.clip(mi.Int32(row) + down, 0, resolution - 1))
            x = mi.UInt32(dr.clip(mi.Int32(column) + right, 0, resolution - 1))
            around += dr.gather(mi.Float64, squared_error, y * resolution + x)
    bright = was - is_now > STANDARD_ERRORS * dr.sqrt(squared_error)
    dark = is_now - was > STANDARD_ERRORS * dr.sqrt(around / 9)
    return (bright & (was > STANDS_OUT * is_now)) | (dark & (is_now > DARKER * was))


def _chosen(right: Any, raw: list[Any], denoised: list[Any]) -> list[Any]:
    return [dr.select(right, *pair) for pair in zip(raw, denoised, strict=True)]


def _estimates(
    a: Any, b: Any, denoised_a: Any, denoised_b: Any, hit: Any, is_filtered: bool
) -> tuple[list[Any], list[Any]]:
    """Return the squared errors and the surprises of pixels (Float64): log, linear, of objects.

    The pictures (Color3d) are those of `Half`.
    """
    raw, denoised = (a + b) / 2, (denoised_a + denoised_b) / 2
    estimate = dr.square(denoised_a - b) + dr.square(denoised_b - a) - dr.square(a - b)
    estimate = estimate / 2 - dr.square(denoised_a - denoised_b) / 4
    errors, surprises = [], []
    for curve in (_log10, _clamped):
        if is_filtered:
            least = SMALLEST_STEP * (1 + dr.abs(denoised))
            step = raw - denoised
            step = dr.select(dr.abs(step) < least, least, step)
            slope = (curve(denoised + step) - curve(denoised)) / step
            errors.append(_mean(dr.square(slope) * estimate))
        else:
            errors.append(_mean(dr.square(curve(a) - curve(b))) / 2)
        surprises.append(_mean(dr.square(curve(raw) - curve(denoised))))
    of_objects = [dr.select(hit, values[0], 0) for values in (errors, surprises)]
    return [*errors, of_objects[0]], [*surprises, of_objects[1]]


def _log10(radiance: Any) -> Any:
    return dr.log(1 + radiance) * _INV_LN_10


def _clamped(radiance: Any) -> Any:
    return dr.clip(radiance, 0, 1)


def _sum(color: Any) -> Any:
    return color.x + color.y + color.z


def _mean(color: Any) -> Any:
    return _sum(color) / 3


def _where_any(mask: Any, values: Any) -> Any:
    return dr.select(dr.any(mask != 0), values, 0)


def _rows_and_columns(resolution: int) -> tuple[Any, Any]:
    pixel = dr.arange(mi.UInt32, resolution**2)
    return pixel // resolution, pixel % resolution


def _of_tiles(values: Sequence[Any], reduction: Any, resolution: int) -> Any:
    """Return values of pixels (Float64) reduced over tiles, those of one value after another's."""
    row, column = _rows_and_columns(resolution)
    tile = row // TILE_PX * (resolution // TILE_PX) + column // TILE_PX
    place = tile * _TILE + row % TILE_PX * TILE_PX + column % TILE_PX
    packed = dr.zeros(mi.Float64, len(values) * resolution**2)
    for number, value in enumerate(values):
        dr.scatter(packed, mi.Float64(value), place + number * resolution**2)
    return dr.block_reduce(reduction, packed, _TILE)


def _totals(values: Sequence[Any], resolution: int) -> Any:
    """Return the sum over all pixels of each of some values (Float64)."""
    sums, across = _of_tiles(values, dr.ReduceOp.Add, resolution), resolution // TILE_PX
    return dr.block_sum(dr.block_sum(sums, across), across)
