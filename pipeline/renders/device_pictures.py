"""`DevicePictures`: the arithmetic of a view as kernels, where its samples are traced.

What is read back are a few numbers of each tile at each look, and the pictures once.
"""

import ctypes
import functools
import operator
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.calibrated_error import (
    METRICS,
    CalibratedStatement,
    is_far,
    measures_of_totals,
    statement_for,
)
from pipeline.renders.device_memory import KernelInputs, record_launches
from pipeline.renders.noise_floor import ErrorMeasures, Halves, MeasuredFloor, measured_floor
from pipeline.renders.pixel_arithmetic import (
    TILE,
    channel_mean,
    channel_sum,
    choose,
    clean,
    converged_mask,
    error_measures,
    estimates,
    log10,
    reduce_tiles,
    shares_of,
    totals,
    where_any,
    with_means_of,
)
from pipeline.renders.samples import TILE_PX, DualBuffer, tile_means
from pipeline.renders.settings import Filtered, RenderSettings
from pipeline.renders.tracer import PixelCamera
from pipeline.renders.view_pictures import (
    LEAST_PASSES,
    Group,
    MeasuredLook,
    add_up,
    floor_groups,
    put_together,
    require_bounded,
    require_finite,
    to_filter,
)
from storage.denoiser import INPUTS, Quality, open_filter

Sums = Sequence[Sequence[Sequence[Any]]]
"""Of each half, and in it of each tracer: `DeviceSum.sums`."""


def read_numbers(numbers: Any) -> NDArray:
    """Return an array of Dr.Jit as one of numpy: all that is read back of a view comes this way."""
    return np.array(numbers)


class DevicePictures:
    """See `ViewPictures` for the meaning of its methods."""

    def __init__(
        self, samples: DualBuffer, tracer: Any, camera: PixelCamera, settings: RenderSettings
    ) -> None:
        """Trace what guides the denoiser.

        Args:
            samples: whose sums are `DeviceSum`.
        """
        self._samples = samples
        self._resolution = camera.resolution
        self._names = settings.part_names
        self._quality = settings.denoiser
        self._settings = settings
        self._picture: Any = None
        arrays = tracer.feature_arrays(camera, spp=settings.aux_spp)
        names = self._names or ("",)
        self._guides, masks = _guides(
            KernelInputs(), arrays, tracer.hit_array(camera), names, camera.resolution
        )
        self._logs = [dr.opaque(mi.Color3d, 0, camera.resolution**2) for _ in range(2)]
        self._masks = masks
        bits = read_numbers(masks).reshape(camera.resolution, camera.resolution)
        self.hits = bits & 1 > 0
        self.visible = bits & 2 > 0
        if not self.visible.any():
            self.visible[:] = True
        hits = TILE * tile_means(self.hits.astype(np.float64)).ravel()
        everywhere = np.full_like(hits, TILE)
        self._counts = everywhere, everywhere, hits

    @staticmethod
    def mean_radiance(samples: DualBuffer) -> float:
        resolution = len(samples.spp_of(0))
        total, broken = read_numbers(_brightness(KernelInputs(), _sums(samples), resolution))
        require_finite(int(broken))
        return float(total) / (3 * resolution**2)

    def look(self, quality: Filtered) -> MeasuredLook:
        statement = statement_for(self._settings, self._samples)
        self._picture = None
        filtered = self._denoise_raws(_sums(self._samples), quality, of_both=False)
        if statement is None or self._settings.picture_within_db is not None:
            look, logs = self._measure(filtered, quality, None)
            if statement is None or is_far(look.floor, self._settings, self._samples.spp):
                self._logs = logs
                return look
        look, self._logs = self._measure(filtered, quality, statement)
        return look

    def _measure(
        self,
        filtered: list[list[Any]],
        quality: Filtered,
        statement: CalibratedStatement | None,
    ) -> tuple[MeasuredLook, Any]:
        """Return a look, by the halves alone without a statement, and the logs of both halves."""
        sums = _sums(self._samples)
        count = sum(len(tracer) - 3 for tracer in sums[0])
        groups = floor_groups(count, self._names, per_light=self._settings.per_light)
        kind = (self._names, groups, self._resolution, quality != "off")
        picture = [] if statement is None else [self._filtered_picture()]
        arrays = sums, filtered, self._guides, self._masks, self._logs, picture
        numbers, logs = _estimate_error(KernelInputs(), *arrays, *kind)
        totals, tiles = np.split(read_numbers(numbers), [6 * len(METRICS) if picture else 0])
        rows = tiles.reshape(-1, len(self._counts[0]))
        require_finite(int(rows[2].sum()))
        require_bounded(float(rows[-1].max()))
        across = self._resolution // TILE_PX
        if statement is None:
            errors, surprises = rows[3:-1].reshape(2, -1, 3, across**2)
            floors = [self._floor(*each) for each in zip(errors, surprises, strict=True)]
            expected = None
        else:
            measures = self._measures(totals.reshape(3, -1), rows[3:-1])
            floor, expected = statement.state(measures, self._resolution, self._samples.spp)
            floors = [floor]
        look = MeasuredLook(
            floor=floors[0],
            part_floors=dict(zip(self._names, floors[1:], strict=False)),
            light_floors=floors[1 + len(self._names) :],
            expected=expected,
            changes=list(rows[:2].reshape(2, across, across) / TILE),
        )
        return look, logs

    def finish(self) -> NDArray[np.float32]:
        pictures = read_numbers(self._filtered_picture())
        return pictures.reshape(-1, self._resolution, self._resolution, 3)

    def _filtered_picture(self) -> Any:
        """Return the pictures of all samples of this look (Float), one after another."""
        if self._picture is None:
            sums = _sums(self._samples)
            kind = (self._names, self._resolution, self._quality != "off")
            filtered = self._denoise_raws(sums, self._quality, of_both=True)
            self._picture = _finish(KernelInputs(), sums, filtered, self._guides, *kind)
        return self._picture

    def _measures(
        self, totals: NDArray[np.float64], surprises: NDArray[np.float64]
    ) -> dict[str, ErrorMeasures]:
        """Return the measures of each metric, from totals [3, 6] and largest surprises [3, T]."""
        share = float(self.hits.mean())
        return {
            name: measures_of_totals(added, float(most.max()), int(count.sum()), share)
            for name, added, most, count in zip(
                METRICS, totals, surprises, self._counts, strict=True
            )
        }

    def _floor(self, errors: NDArray[np.float64], most: NDArray[np.float64]) -> MeasuredFloor:
        """Return the floor of estimates and surprises of tiles [3, T]: log, linear, of objects."""
        return measured_floor(
            (error.sum() / max(count.sum(), 1), float(surprise.max()), error, count)
            for error, surprise, count in zip(errors, most, self._counts, strict=True)
        )

    def _denoise_raws(self, sums: Sums, quality: Filtered, *, of_both: bool) -> list[list[Any]]:
        """Return what the denoiser makes of each half, or of the mean of both."""
        if quality == "off":
            return []
        raws = _raws(KernelInputs(), sums, self._names, of_both, self._resolution)
        pictures = range(sum(len(tracer) - 3 for tracer in sums[0]))
        names = [name for _, name in to_filter(pictures, self._names)]
        guides = [self._guides[name] for name in names]
        return [denoise_arrays(raw, guides, self._resolution, quality) for raw in raws]


def _sums(samples: DualBuffer) -> Sums:
    return [[each.sums for each in half] for half in samples.sums]  # type: ignore[attr-defined]


@record_launches
def _brightness(_: Any, sums: Sums, resolution: int) -> Any:
    """Return the sum of all channels of the mean of both halves, and the broken pixels."""
    means = [add_up(half) for half in _half_means(sums)]
    return totals([channel_sum(add_up(means)) / 2, _broken(sums)], resolution)


@record_launches
def _guides(
    _: Any, arrays: dict[str, Any], hits: Any, names: Sequence[str], resolution: int
) -> tuple[Any, Any]:
    """Return albedo and normal by the name of a part, as `Features.of_part`, and hits and shown."""
    normal: Any = mi.Color3f(arrays["normal"])
    guides = dict[str, Any]()
    for name in names:
        albedo = mi.Color3f(arrays.get(name.partition("_")[0], arrays["albedo"]))
        seen = normal if name.partition("_")[0] not in arrays else where_any(albedo, normal)
        guides[name] = dr.ravel(albedo), dr.ravel(seen)
    visible: Any = functools.reduce(operator.or_, normal != 0)
    byte: Any = mi.UInt8
    return guides, byte(dr.select(hits, 1, 0) + dr.select(visible, 2, 0))


@record_launches
def _raws(
    _: Any, sums: Sums, names: Sequence[str], of_both: bool, resolution: int
) -> list[list[Any]]:
    """Return what the denoiser is asked for, of each half or of both (Float, pixel by pixel)."""
    return [
        [dr.ravel(picture) for picture, _ in to_filter(means, names)]
        for means in _means(sums, of_both)
    ]


@record_launches
def _estimate_error(
    _: Any,
    sums: Sums,
    filtered: list[list[Any]],
    guides: dict[str, Any],
    masks: Any,
    logs: Sequence[Any],
    finished: list[Any],
    names: Sequence[str],
    groups: Sequence[Group],
    resolution: int,
    is_filtered: bool,
) -> tuple[Any, list[Any]]:
    """Return rows of numbers of all tiles (Float64), and the log radiance of both halves.

    The rows are sums: the changes of both halves, broken pixels, and three estimates of each of
    `floor_groups`; then what is greatest: surprises of the same, and the brightest raw channel.
    With `finished`, one denoise of all samples, the totals of `error_measures` come first, and no
    estimates.
    """
    raws = _means(sums, of_both=False)
    denoised = _clean_pictures(raws, filtered, guides, names, resolution) if is_filtered else raws
    new_logs = [log10(mi.Color3d(add_up(each))) for each in denoised]
    changes = [channel_mean(dr.square(new - old)) for new, old in zip(new_logs, logs, strict=True)]
    corrected = denoised
    if is_filtered and len(sums[0]) == 1:
        picture = [[(a + b) / 2 for a, b in zip(*each, strict=True)] for each in (denoised, raws)]
        error = _squared_error_of_means(sums)
        right = converged_mask(picture[0], picture[1], error, resolution)
        corrected = [choose(right, *each) for each in zip(raws, denoised, strict=True)]
    hit = (masks & 1) > 0
    totals = []
    rows: list[tuple[list[Any], list[Any]]] = []
    for group in groups:
        a, b, da, db = (mi.Color3d(add_up(each[slice(*group)])) for each in (*raws, *corrected))
        halves = Halves(a, b, da, db, da - db)
        if finished:
            denoised_both = mi.Color3d(dr.unravel(mi.Color3f, finished[0]))
            measured, surprises = error_measures(halves, denoised_both, hit, resolution)
            totals.append(measured)
            rows.append(([], surprises))
        else:
            rows.append(estimates(halves, hit, is_filtered))
    brightest = functools.reduce(dr.maximum, [dr.max(part) for half in raws for part in half])
    adds = [*changes, _broken(sums), *(row for errors, _ in rows for row in errors)]
    most = [*(row for _, surprises in rows for row in surprises), brightest]
    dr.eval(new_logs)
    sums_of_tiles = reduce_tiles(adds, dr.ReduceOp.Add, resolution)
    most_of_tiles = reduce_tiles(most, dr.ReduceOp.Max, resolution)
    return dr.concat([*totals, sums_of_tiles, most_of_tiles]), new_logs


@record_launches
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
        (pictures,) = _clean_pictures(raws, filtered, guides, names, resolution)
        if len(sums[0]) == 1:
            right = converged_mask(pictures, raws[0], _squared_error_of_means(sums), resolution)
            pairs = list(zip(choose(right, raws[0], pictures), raws[0], strict=True))
            pictures = with_means_of(pairs, resolution)
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
    greys = [channel_mean(add_up(half)) for half in _half_means(sums)]
    mean = (greys[0] + greys[1]) / 2
    spread = mi.Float64(0)
    count = mi.Float64(0)
    shares = mi.Float64(0)
    for grey, (tracer,) in zip(greys, sums, strict=True):
        squares, spp, passes = tracer[-3:]
        spread += squares - spp * mean * (2 * grey - mean)
        count += passes
        shares += 1 / spp
    error = dr.maximum(spread, 0) / (count - 1) * shares / 4
    return dr.select(count < LEAST_PASSES, dr.inf, error)


def _clean_pictures(
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
        cleaned = [
            clean(mi.Color3f(dr.unravel(mi.Color3f, output)), raw, guides[name][1])
            for output, (raw, name) in zip(outputs, inputs, strict=True)
        ]
        if len(inputs) > len(names or ("",)):  # lights alone: of no light nothing is painted
            lit = totals([channel_sum(mi.Color3d(raw)) for raw, _ in inputs], resolution)
            cleaned = [
                dr.select(dr.gather(mi.Float64, lit, row) > 0, picture, 0)
                for row, picture in enumerate(cleaned)
            ]
        with_means = functools.partial(with_means_of, resolution=resolution)
        denoised.append(put_together(pictures, cleaned, names, with_means, shares_of))
    return denoised


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


class _DLTensor(ctypes.Structure):
    """The head of DLPack's structure of that name."""

    _fields_ = (
        ("data", ctypes.c_void_p),
        ("device", ctypes.c_int32 * 2),
        ("ndim", ctypes.c_int32),
        ("dtype", ctypes.c_uint8 * 4),
        ("shape", ctypes.c_void_p),
        ("strides", ctypes.c_void_p),
        ("byte_offset", ctypes.c_uint64),
    )


_capsule_pointer = ctypes.pythonapi.PyCapsule_GetPointer
_capsule_pointer.restype = ctypes.c_void_p
_capsule_pointer.argtypes = [ctypes.py_object, ctypes.c_char_p]


def _address(array: Any) -> int:
    """Return where an evaluated array of Dr.Jit is, in the memory of its device."""
    capsule = array.__dlpack__()
    tensor = _DLTensor.from_address(_capsule_pointer(capsule, b"dltensor"))
    return int(tensor.data) + int(tensor.byte_offset)
