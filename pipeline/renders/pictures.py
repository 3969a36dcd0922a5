"""`ViewPictures`: what the samples of a view show and how far it is from the truth, as they grow.

Here they are worked out in numpy, on sums that are read back. Sets choose it by their render
settings (`arithmetic`); all others take pipeline.renders.device_pictures, of which this is the
tests' oracle. Both have the same formulas; `Pixels` are the operations that they write unlike.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.calibrated_error import METRICS, is_far, measures_of_totals, statement_for
from pipeline.renders.noise_floor import (
    Curve,
    ErrorMeasures,
    measured_floor,
    secant_slope,
)
from pipeline.renders.samples import TILE_PX, DualBuffer, tile_means
from pipeline.renders.settings import Filtered, RenderSettings
from pipeline.renders.tracer import PixelCamera
from pipeline.renders.view_pictures import (
    DARKER,
    LEAST_PASSES,
    STANDARD_ERRORS,
    STANDS_OUT,
    Group,
    MeasuredLook,
    Pixels,
    add_up,
    floor_groups,
    put_together,
    require_bounded,
    require_finite,
    to_filter,
)
from storage.denoiser import Features, Quality, denoise
from storage.records.sample import PictureErrors

if TYPE_CHECKING:
    from pipeline.renders.vector_tracer import VectorTracer

TILE = TILE_PX * TILE_PX
"""Pixels of a tile."""

Sums = Sequence[Sequence[Sequence[Any]]]
"""Of each half, and in it of each tracer: `DeviceSum.sums`, or what `DeviceSum.read` returns."""

_CHANNEL_ROWS = 13
"""Rows of a metric in `error_measures`: four values, and three colors by channel."""


class Halves(NamedTuple):
    """Both halves of the samples of a picture, which share none: numpy [R, R, 3], or Color3d."""

    a: Any
    b: Any
    """Means of the samples, in double precision."""
    denoised_a: Any
    denoised_b: Any
    difference: Any
    """Difference of both denoised ones."""

    @property
    def raw(self) -> Any:
        """Mean of both halves."""
        return (self.a + self.b) / 2

    @property
    def denoised(self) -> Any:
        """Mean of both denoised halves."""
        return (self.denoised_a + self.denoised_b) / 2


def pixel_errors(
    halves: Halves, curve: Curve, pixels: Pixels, *, is_filtered: bool
) -> tuple[Any, Any]:
    """Return the estimate and the surprise of each pixel in a curve, as means over its channels.

    Single estimates may be far below 0; the mean over many pixels is what they are for. A surprise
    is the squared difference that the denoiser made in the mean of both halves.
    """
    mean = pixels.channel_mean
    surprise = mean(_square(curve(halves.raw) - curve(halves.denoised)))
    if not is_filtered:
        return mean(_square(curve(halves.a) - curve(halves.b))) / 2, surprise
    slope = secant_slope(curve, halves.denoised, halves.raw, select=pixels.select)
    a, b, denoised_a, denoised_b, difference = halves
    estimate = _square(denoised_a - b) + _square(denoised_b - a) - _square(a - b)
    return mean(_square(slope) * (estimate / 2 - _square(difference) / 4)), surprise


def pixel_measures(
    halves: Halves, picture: Any, curve: Curve, pixels: Pixels
) -> tuple[list[Any], list[Any], Any]:
    """Return what `ErrorMeasures` are made of, pixel by pixel.

    Args:
        halves: of the samples.
        picture: one denoise of the mean of both, as they are.
        curve: tone curve in which errors are taken.
        pixels: operations on all of these.

    Returns:
        Estimate, agreement, move, and a quarter of the squared difference of the halves with the
        picture's slope; residual, probe and difference of `sure` with that slope, by channel; and
        the surprise.
    """
    mean = pixels.channel_mean
    estimate, surprise = pixel_errors(halves, curve, pixels, is_filtered=True)
    slope = secant_slope(curve, picture, halves.raw, select=pixels.select)
    difference = slope * (halves.denoised_a - halves.denoised_b)
    values = [
        estimate,
        mean(_square(curve(halves.denoised_a) - curve(halves.denoised_b))) / 4,
        mean(_square(curve(picture) - curve(halves.denoised))),
        mean(_square(difference)) / 4,
    ]
    signed = [slope * (picture - halves.raw), slope * (halves.a - halves.b) / 2, difference]
    return values, signed, surprise


def _square(value: Any) -> Any:
    return value * value


def half_means(sums: Sums, pixels: Pixels) -> list[list[Any]]:
    """Return the mean of each half, of each picture, in double precision."""
    return [
        [pixels.mean(total, tracer[-2]) for tracer in half for total in tracer[:-3]]
        for half in sums
    ]


def means(sums: Sums, pixels: Pixels, *, of_both: bool) -> list[list[Any]]:
    """Return the mean of each half, or of both alone, of each picture.

    Both halves weigh the same even where one has more samples: what one half is given goes by the
    other's, and weights by it would make the sum depend on itself (pipeline.renders.samples).
    """
    halves = half_means(sums, pixels)
    if of_both:
        halves = [[(a + b) / 2 for a, b in zip(*halves, strict=True)]]
    return [[pixels.single(picture) for picture in half] for half in halves]


def broken_pixels(sums: Sums, pixels: Pixels) -> Any:
    """Return 1 for pixels with a sum that is not finite, else 0."""
    totals = [total for half in sums for tracer in half for total in tracer[:-3]]
    finite = functools.reduce(lambda a, b: a & b, map(pixels.is_finite, totals))
    return pixels.select(finite, 0.0, 1.0)


def squared_error(sums: Sums, pixels: Pixels) -> Any:
    """Return that of the grey value of the mean of both halves, by the spread between all passes.

    It is infinite where there are fewer than LEAST_PASSES.
    """
    greys = [pixels.channel_mean(add_up(half)) for half in half_means(sums, pixels)]
    mean = (greys[0] + greys[1]) / 2
    spread: Any = 0.0
    count: Any = 0.0
    shares: Any = 0.0
    for grey, (tracer,) in zip(greys, sums, strict=True):
        squares, spp, passes = tracer[-3:]
        # Passes of n samples have the variance v / n, and the mean of a half of N has v / N.
        spread += squares - spp * mean * (2 * grey - mean)
        count += passes
        shares += 1 / spp
    error = pixels.maximum(spread, 0) / (count - 1) * shares / 4
    return pixels.select(count < LEAST_PASSES, np.inf, error)


def converged_mask(
    denoised: Sequence[Any], raw: Sequence[Any], squared_error: Any, pixels: Pixels
) -> Any:
    """Return which pixels of the raw picture are right rather than the denoised ones.

    Args:
        denoised: linear radiance of the parts of a picture, which is their sum.
        raw: the mean of the samples.
        squared_error: of the mean over the channels of the sum of `raw`, from the spread between
            at least LEAST_PASSES passes.
        pixels: operations on all of these.
    """
    is_now, was = (pixels.channel_mean(pixels.double(add_up(parts))) for parts in (denoised, raw))
    error = pixels.sqrt(squared_error)
    around = pixels.error_around(squared_error)
    bright = (was - is_now > STANDARD_ERRORS * error) & (was > STANDS_OUT * is_now)
    dark = (is_now - was > STANDARD_ERRORS * around) & (is_now > DARKER * was)
    return bright | dark


def keep_in_halves(
    raws: Sequence[Sequence[Any]], denoised: Sequence[Sequence[Any]], error: Any, pixels: Pixels
) -> list[list[Any]]:
    """Return the denoised halves with the raw pixels that the mean of both keeps.

    So the floor is that of the picture: of a glint that is kept, what remains is its noise.
    """
    is_now, was = (
        [(a + b) / 2 for a, b in zip(*halves, strict=True)] for halves in (denoised, raws)
    )
    mask = converged_mask(is_now, was, error, pixels)
    return [keep(mask, *halves, pixels) for halves in zip(raws, denoised, strict=True)]


def keep(mask: Any, raw: Sequence[Any], denoised: Sequence[Any], pixels: Pixels) -> list[Any]:
    return [pixels.select(mask, *pair) for pair in zip(raw, denoised, strict=True)]


def clean_pictures(
    raws: Sequence[Sequence[Any]],
    filtered: Sequence[Any],
    guides: Any,
    pixels: Pixels,
    names: Sequence[str],
) -> list[list[Any]]:
    """Return the pictures without noise, from what the denoiser made of them."""
    denoised = []
    for pictures, outputs in zip(raws, filtered, strict=True):
        inputs = list(to_filter(pictures, names))
        are_lights = len(inputs) > len(names or ("",))
        cleaned = pixels.clean(inputs, outputs, guides, are_lights=are_lights)
        denoised.append(put_together(pictures, cleaned, names, pixels))
    return denoised


def raws_to_filter(
    pixels: Pixels, sums: Sums, names: Sequence[str], of_both: bool
) -> list[list[Any]]:
    """Return what the denoiser is asked for, of each half or of both, as it takes pictures."""
    return [
        [pixels.flat(picture) for picture, _ in to_filter(pictures, names)]
        for pictures in means(sums, pixels, of_both=of_both)
    ]


def finish_pictures(
    pixels: Pixels, sums: Sums, filtered: Sequence[Any], guides: Any, names: Sequence[str]
) -> list[Any]:
    """Return the pictures of all samples; those that nothing filtered are the raw ones."""
    raws = means(sums, pixels, of_both=True)
    if not filtered:
        return raws[0]
    (pictures,) = clean_pictures(raws, filtered, guides, pixels, names)
    if len(sums[0]) > 1:  # passes of several tracers are not added: no error tells what is right
        return pictures
    mask = converged_mask(pictures, raws[0], squared_error(sums, pixels), pixels)
    corrected = keep(mask, raws[0], pictures, pixels)
    return pixels.with_means(list(zip(corrected, raws[0], strict=True)))


def measure_pixels(
    pixels: Pixels,
    names: Sequence[str],
    groups: Sequence[Group],
    sums: Sums,
    filtered: Sequence[Any],
    guides: Any,
    hit: Any,
    logs: Sequence[Any],
    finished: Sequence[Any],
) -> tuple[Any, list[Any]]:
    """Measure the halves, and with `finished`, one denoise of all samples, the error of that.

    Returns:
        `Pixels.one_row`, and the log radiance of both halves. Totals are those of
        `measures_of_totals`, of one metric after another; none without a picture. Added up are the
        changes of both halves, broken pixels, and three estimates of each of `floor_groups`; no
        estimates with a picture. The greatest counts of surprises of the same, and of the brightest
        raw channel.
    """
    raws = means(sums, pixels, of_both=False)
    denoised = clean_pictures(raws, filtered, guides, pixels, names) if filtered else raws
    new_logs = [pixels.log10(pixels.double(add_up(each))) for each in denoised]
    changes = [
        pixels.channel_mean((new - old) * (new - old))
        for new, old in zip(new_logs, logs, strict=True)
    ]
    corrected = denoised
    if filtered and len(sums[0]) == 1:
        corrected = keep_in_halves(raws, denoised, squared_error(sums, pixels), pixels)
    totals = []
    errors: list[Any] = []
    surprises: list[Any] = []
    for group in groups:
        a, b, denoised_a, denoised_b = (add_up(each[slice(*group)]) for each in (*raws, *corrected))
        halves = join_halves(a, b, denoised_a, denoised_b, pixels)
        if not finished:
            rows = estimates(halves, hit, pixels, bool(filtered))
            errors += [error for error, _ in rows]
            surprises += [surprise for _, surprise in rows]
        else:
            measured, more = error_measures(halves, pixels.double(finished[0]), hit, pixels)
            totals.append(measured)
            surprises += more
    channels = [pixels.brightest(part) for half in raws for part in half]
    brightest = functools.reduce(pixels.maximum, channels)
    adds = [*changes, broken_pixels(sums, pixels), *errors]
    return pixels.one_row(totals, adds, [*surprises, brightest], new_logs), new_logs


def join_halves(a: Any, b: Any, denoised_a: Any, denoised_b: Any, pixels: Pixels) -> Halves:
    """Return both halves of a picture, raw and denoised, in double precision."""
    doubles = [pixels.double(each) for each in (a, b, denoised_a, denoised_b)]
    return Halves._make([*doubles, pixels.difference(denoised_a, denoised_b)])


def estimates(halves: Halves, hit: Any, pixels: Pixels, is_filtered: bool) -> list[tuple[Any, Any]]:
    """Return the squared errors and the surprises of pixels: log, linear, of objects."""
    rows = [
        pixel_errors(halves, curve, pixels, is_filtered=is_filtered)
        for curve in (pixels.log10, pixels.clamp)
    ]
    error, surprise = rows[0]
    return [*rows, (pixels.select(hit, error, 0), pixels.select(hit, surprise, 0))]


def error_measures(halves: Halves, picture: Any, hit: Any, pixels: Pixels) -> tuple[Any, list[Any]]:
    """Return the totals of `measures_of_totals`, of one metric after another, and surprises."""
    metrics = []
    surprises = []
    for curve in (pixels.log10, pixels.clamp):
        values, signed, surprise = pixel_measures(halves, picture, curve, pixels)
        metrics.append([*values, *(each for color in signed for each in pixels.channels(color))])
        surprises.append(surprise)
    metrics.append([pixels.select(hit, each, 0) for each in metrics[0]])
    tiles = pixels.tile_sums([each for values in metrics for each in values])
    totals: list[Any] = []
    for first in range(0, len(tiles), _CHANNEL_ROWS):
        rows = tiles[first : first + _CHANNEL_ROWS]
        triples = zip(rows[4:7], rows[7:10], rows[10:], strict=True)
        sure = add_up([x * x + z * h - z * z for x, z, h in triples])
        totals += [*rows[:4], sure / 3, add_up([h * h for h in rows[10:]]) / 12]
    return pixels.totals_of_tiles(totals), [*surprises, pixels.select(hit, surprises[0], 0)]


@dataclass(frozen=True, kw_only=True, eq=False)
class LookNumbers:
    """What a look reads of its pixels."""

    totals: NDArray[np.float64]
    """[3, 6] totals of `measures_of_totals`; empty without a picture."""
    adds: NDArray[np.float64]
    """[N, T] sums over tiles of what `measure_pixels` adds up."""
    most: NDArray[np.float64]
    """[M, T] largest in each tile of what the greatest counts of."""
    logs: Sequence[Any]
    """Log radiance of both halves."""


def metric_counts(hits: NDArray[np.bool_]) -> tuple[NDArray[np.float64], ...]:
    """Return the pixels of each tile, [T], that count in log and linear light and of objects."""
    objects = TILE * tile_means(hits.astype(np.float64)).ravel()
    everywhere = np.full_like(objects, TILE)
    return everywhere, everywhere, objects


def floors_of(
    adds: NDArray[np.float64], most: NDArray[np.float64], counts: tuple[NDArray[np.float64], ...]
) -> list[PictureErrors]:
    """Return the floors of `floor_groups`, by `LookNumbers` of the halves and `metric_counts`."""
    errors = adds[3:]
    surprises = most[:-1].max(axis=1)
    counts = counts * (len(errors) // 3)
    rows = list(zip(surprises, errors, counts, strict=True))
    return [measured_floor(rows[first : first + 3]) for first in range(0, len(rows), 3)]


NUMPY = Pixels()


def read_sums(samples: DualBuffer) -> Sums:
    """Return the sums of a view; raises Rejected("nonfinite_radiance")."""
    sums = [[each.read() for each in half] for half in samples.sums]
    require_finite(int(broken_pixels(sums, NUMPY).sum()))
    return sums


def read_bounded(samples: DualBuffer) -> Sums:
    """Return the sums of a view; raises as `ViewPictures.look`."""
    sums = read_sums(samples)
    require_bounded(float(np.max(means(sums, NUMPY, of_both=False))))
    return sums


class ViewPictures:
    """The pictures of one view, of samples that grow.

    There are P of them, of lights and of their parts: all parts of the first light come first.
    """

    _pixels: Pixels = NUMPY
    _inputs: Any = staticmethod(lambda pixels: pixels)
    """Wrapper of `_pixels` for recorded functions."""
    _read: Any = staticmethod(read_bounded)
    _raws: Any = staticmethod(raws_to_filter)
    _finish: Any = staticmethod(finish_pictures)
    _measure: Any = staticmethod(measure_pixels)
    hits: NDArray[np.bool_]
    """[R, R] true where `VectorTracer.hits` is."""
    visible: NDArray[np.bool_]
    """[R, R] pixels with a first surface, anywhere within the pixel; all of them if none has."""

    def __init__(
        self,
        samples: DualBuffer,
        tracer: "VectorTracer",
        camera: PixelCamera,
        settings: RenderSettings,
    ) -> None:
        """Begin a view of a camera with the samples that are there."""
        self._samples = samples
        self._settings = settings
        self._names = settings.part_names
        self._logs: Sequence[Any] = (0.0, 0.0)
        self._filtered: Sequence[Any] = []
        self._picture: Any = None
        self.hits, visible = self._trace_guides(tracer, camera)
        self.visible = visible if visible.any() else np.ones_like(visible)
        self._counts = metric_counts(self.hits)

    def _trace_guides(
        self, tracer: "VectorTracer", camera: PixelCamera
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Trace what guides the denoiser; return pixels that hit and that show anything."""
        shape = (camera.resolution, camera.resolution, 3)
        guides = tracer.guides(camera, self._names, spp=self._settings.aux_spp)
        self._guides: Any = {
            name: Features(albedo=albedo.reshape(shape), normal=normal.reshape(shape))
            for name, (albedo, normal) in ((name, map(np.array, guides[name])) for name in guides)
        }
        self._hit: Any = tracer.hits(camera)
        return self._hit, np.any(self._guides[""].normal != 0, axis=-1)

    @staticmethod
    def mean_radiance(samples: DualBuffer) -> float:
        """Return the mean radiance of all pixels so far; raises as `look`."""
        (pictures,) = means(read_sums(samples), NUMPY, of_both=True)
        return float(add_up(pictures).mean(dtype=np.float64))

    def look(self, quality: Filtered) -> MeasuredLook:
        """Return what is measured now, with halves denoised by a filter of this quality.

        Raises:
            Rejected: "nonfinite_radiance" where a raw sample is not finite, "radiance_overflow".
        """
        statement = statement_for(self._settings, self._samples)
        self._sums = self._read(self._samples)
        self._picture = None
        self._filtered = self._denoise_raws(quality, of_both=False)
        if statement is None or self._settings.picture_within_db is not None:
            numbers = self._numbers(())
            floors = floors_of(numbers.adds, numbers.most, self._counts)
            if statement is None or is_far(floors[0], self._settings, self._samples.spp):
                return self._look(numbers, floors, None)
        numbers = self._numbers(self._make_pictures()[:1])
        resolution = len(self.hits)
        floor, expected = statement.state(self._measures(numbers), resolution, self._samples.spp)
        return self._look(numbers, [floor], expected)

    def _look(
        self, numbers: LookNumbers, floors: list[PictureErrors], expected: PictureErrors | None
    ) -> MeasuredLook:
        self._logs = numbers.logs
        self._filtered = []  # memory for the passes that follow
        across = len(self.hits) // TILE_PX
        return MeasuredLook(
            floor=floors[0],
            part_floors=dict(zip(self._names, floors[1:], strict=False)),
            light_floors=floors[1 + len(self._names) :],
            expected=expected,
            changes=list(numbers.adds[:2].reshape(2, across, across) / TILE),
        )

    def _measures(self, numbers: LookNumbers) -> dict[str, ErrorMeasures]:
        """Return the measures of the picture by metric."""
        share = float(self.hits.mean())
        return {
            name: measures_of_totals(added, float(most.max()), int(count.sum()), share)
            for name, added, most, count in zip(
                METRICS, numbers.totals, numbers.most[:-1], self._counts, strict=True
            )
        }

    def finish(self) -> NDArray[np.float32]:
        """Return the pictures of all samples of the last look, [P, R, R, 3]."""
        return np.stack(self._make_pictures())

    def _make_pictures(self) -> list[Any]:
        """Return the pictures of `finish` where they are worked out, once for a look."""
        if self._picture is None:
            filtered = self._denoise_raws(self._settings.denoiser, of_both=True)
            inputs = self._inputs(self._pixels)
            self._picture = self._finish(inputs, self._sums, filtered, self._guides, self._names)
        return self._picture

    def _denoise_raws(self, quality: Filtered, *, of_both: bool) -> Sequence[Any]:
        if quality == "off":
            return []
        raws = self._raws(self._inputs(self._pixels), self._sums, self._names, of_both)
        pictures = range(sum(len(tracer) - 3 for tracer in self._sums[0]))
        guides = [self._guides[name] for _, name in to_filter(pictures, self._names)]
        return [self._denoise(each, guides, quality) for each in raws]

    def _denoise(self, raws: Sequence[Any], guides: Sequence[Any], quality: Quality) -> list[Any]:
        return [denoise(*pair, quality) for pair in zip(raws, guides, strict=True)]

    def _numbers(self, finished: Sequence[Any]) -> LookNumbers:
        arrays = self._sums, self._filtered, self._guides, self._hit, self._logs, finished
        groups = self._groups()
        row, logs = self._measure(self._inputs(self._pixels), self._names, groups, *arrays)
        totals, tiles = np.split(np.array(row), [6 * len(METRICS) if finished else 0])
        rows = tiles.reshape(-1, len(self._counts[0]))
        adds, most = np.split(rows, [3 if finished else 3 + 3 * len(groups)])
        require_finite(int(adds[2].sum()))
        require_bounded(float(most[-1].max()))
        return LookNumbers(totals=totals.reshape(-1, 6), adds=adds, most=most, logs=logs)

    def _groups(self) -> Sequence[Group]:
        count = len(self._samples.sums[0]) * max(1, len(self._names))
        return floor_groups(count, self._names, per_light=self._settings.per_light)
