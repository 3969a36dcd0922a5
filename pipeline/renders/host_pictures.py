"""`HostPictures`: the arithmetic of a view in numpy, on sums that are read back.

All that must stay in numpy for published sets is here: sums in another order change last digits.
Sets choose it by their render settings (`arithmetic`). All others take
pipeline.renders.device_pictures, of which this is the tests' oracle.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from pipeline.renders.calibrated_error import is_far, measures_of_totals, statement_for
from pipeline.renders.noise_floor import (
    Curve,
    ErrorMeasures,
    Halves,
    MeasuredFloor,
    PixelArithmetic,
    clamped_radiance,
    measured_floor,
    pixel_errors,
    pixel_measures,
)
from pipeline.renders.samples import DualBuffer, by_tiles, tile_means
from pipeline.renders.settings import Filtered, RenderSettings
from pipeline.renders.tracer import PixelCamera, Tracer
from pipeline.renders.view_pictures import (
    GLINT,
    LEAST_PASSES,
    MOST_APART,
    MeasuredLook,
    floor_groups,
    put_together,
    require_bounded,
    require_finite,
    stands_out,
    to_filter,
)
from storage.conventions import log10_radiance
from storage.denoiser import denoise


@dataclass(frozen=True, kw_only=True, eq=False)
class Half:
    """One half of the samples of a view."""

    raw_rgb: NDArray[np.float32]
    """[R, R, 3] mean of the samples."""
    denoised_rgb: NDArray[np.float32]
    """[R, R, 3] the same, denoised."""


NUMPY = PixelArithmetic(
    select=np.where,
    channel_mean=lambda values: values.mean(axis=-1),
    log10=log10_radiance,
    clamp=clamped_radiance,
)


def join_halves(a: Half, b: Half) -> Halves:
    """Return both halves in double precision; their difference is taken before."""
    raws = a.raw_rgb, b.raw_rgb
    denoised = a.denoised_rgb, b.denoised_rgb, a.denoised_rgb - b.denoised_rgb
    return Halves(*(values.astype(np.float64) for values in (*raws, *denoised)))


def estimate_error(a: Half, b: Half, hits: NDArray[np.bool_]) -> MeasuredFloor:
    """Return the floor of the picture made from both halves.

    Args:
        a, b: halves that share no sample, denoised apart.
        hits: [R, R] pixels that show geometry.
    """
    halves = join_halves(a, b)
    is_filtered = not np.array_equal(a.denoised_rgb, a.raw_rgb)
    rows = []
    for _, curve, objects in _METRICS:
        pixels = hits if objects else np.ones_like(hits)
        error, surprise = (
            values * pixels
            for values in pixel_errors(halves, curve, NUMPY, is_filtered=is_filtered)
        )
        sums, counts = (
            by_tiles(values).sum(axis=(1, 3)).ravel()
            for values in (error, pixels.astype(np.float64))
        )
        mean = error.sum() / max(int(pixels.sum()), 1)
        rows.append((mean, float(surprise.max()), sums, counts))
    return measured_floor(rows)


def measure_errors(
    a: Half, b: Half, picture_rgb: NDArray[np.float32], curve: Curve, hits: NDArray[np.bool_],
    *, objects: bool = False,
) -> ErrorMeasures:  # fmt: skip
    """Return what the halves say of the error of the picture of both.

    Args:
        a, b: halves that share no sample, denoised apart.
        picture_rgb: [R, R, 3] one denoise of the mean of both.
        curve: tone curve in which errors are taken.
        hits: [R, R] pixels that show geometry.
        objects: count these pixels alone.
    """
    pixels = hits if objects else np.ones_like(hits)
    picture = picture_rgb.astype(np.float64)
    values, signed, surprise = pixel_measures(join_halves(a, b), picture, curve, NUMPY)
    x, z, h = (by_tiles(each * pixels[..., None]).sum(axis=(1, 3)) for each in signed)
    blocks = [np.mean(each, axis=-1).sum() for each in (x * x + z * h - z * z, h * h / 4)]
    totals = np.array([*((each * pixels).sum() for each in values), *blocks])
    most = float((surprise * pixels).max())
    return measures_of_totals(totals, most, int(pixels.sum()), float(hits.mean()))


_METRICS = (
    ("log", log10_radiance, False),
    ("linear", clamped_radiance, False),
    ("object", log10_radiance, True),
)
"""Name, curve, and whether pixels of objects alone count, of each metric."""

Pictures = NDArray[np.float32]
"""[P, R, R, 3] pictures of the parts of light of one view."""


def keep_converged(
    denoised_rgb: NDArray[np.float32],
    raw_rgb: NDArray[np.float32],
    standard_error: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return the denoised picture with the raw pixels of `converged_mask`."""
    mask = converged_mask(denoised_rgb, raw_rgb, standard_error)
    return np.where(mask[..., None], raw_rgb, denoised_rgb)


def keep_in_halves(
    halves: Sequence[tuple[Pictures, Pictures]], standard_error: NDArray[np.float64]
) -> list[tuple[Pictures, Pictures]]:
    """Return both halves, raw and denoised, with the pixels that the mean of both keeps.

    So the floor is that of the picture: of a glint that is kept, what remains is its noise.
    """
    raw_rgb, denoised_rgb = (np.mean(pictures, axis=0) for pictures in zip(*halves, strict=True))
    mask = converged_mask(denoised_rgb, raw_rgb, standard_error)[..., None]
    return [(raw, np.where(mask, raw, denoised)) for raw, denoised in halves]


def converged_mask(
    denoised_rgb: NDArray[np.floating],
    raw_rgb: NDArray[np.floating],
    standard_error: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Return which pixels [R, R] of the raw picture are right rather than the denoised ones.

    Args:
        denoised_rgb: [P, R, R, 3] linear radiance of the parts of a picture, which is their sum.
        raw_rgb: [P, R, R, 3] the mean of the samples.
        standard_error: [R, R] of the mean over the channels of the sum of `raw_rgb`, from the
            spread between at least LEAST_PASSES passes.
    """
    raw, denoised = (
        parts.sum(axis=0).mean(axis=-1, dtype=np.float64) for parts in (raw_rgb, denoised_rgb)
    )
    around = np.sqrt(sliding_window_view(np.pad(standard_error**2, 1, "edge"), (3, 3)).mean((2, 3)))
    mask: NDArray[np.bool_] = stands_out(denoised, raw, standard_error, around)
    return mask


def with_mean_of(
    denoised_rgb: NDArray[np.float32], raw_rgb: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the denoised picture with the mean brightness of the raw one.

    Args:
        denoised_rgb: [..., 3] linear radiance.
        raw_rgb: the same view before the denoiser.
    """
    glints = denoised_rgb.mean(axis=-1) > GLINT
    factors = [_factor(denoised_rgb[part], raw_rgb[part]) for part in (glints, ~glints)]
    if min(factors) < 1 / MOST_APART or max(factors) > MOST_APART:
        factors = [_factor(denoised_rgb, raw_rgb)] * 2
    return (denoised_rgb * np.where(glints, *factors)[..., None]).astype(np.float32)


def _factor(denoised_rgb: NDArray[np.float32], raw_rgb: NDArray[np.float32]) -> float:
    is_now = denoised_rgb.sum(dtype=np.float64)
    return float(raw_rgb.sum(dtype=np.float64) / is_now) if is_now > 0 else 1.0


class HostPictures:
    """See `ViewPictures` for the meaning of its methods."""

    def __init__(
        self, samples: DualBuffer, tracer: Tracer, camera: PixelCamera, settings: RenderSettings
    ) -> None:
        self._samples = samples
        self._settings = settings
        self._features = tracer.features(camera, spp=settings.aux_spp)
        self.hits = tracer.hits(camera)
        self.visible: NDArray[np.bool_] = np.any(self._features.normal != 0, axis=-1)
        if not self.visible.any():
            self.visible[:] = True
        self._changes = LogChanges()
        self._picture: NDArray[np.float32] | None = None

    @staticmethod
    def mean_radiance(samples: DualBuffer) -> float:
        return float(HostMeans(samples).mean().sum(axis=0).mean(dtype=np.float64))

    def look(self, quality: Filtered) -> MeasuredLook:
        names = self._settings.part_names
        self._means = means = HostMeans(self._samples)
        pairs = [(raw, self._denoise(raw, quality)) for raw in means.half_means()]
        error = means.standard_error()
        corrected = pairs
        if error is not None and self._settings.denoiser != "off":
            corrected = keep_in_halves(pairs, error)
        halves = []
        for group in floor_groups(len(pairs[0][0]), names, per_light=self._settings.per_light):
            chosen = slice(*group)
            a, b = (_half((raw[chosen], rest[chosen])) for raw, rest in corrected)
            halves.append((a, b))
        self._halves = halves[0]  # a subclass of the benchmark reads them
        first, second = self._halves
        self._picture = None
        statement = statement_for(self._settings, self._samples)
        floors = [estimate_error(*each, self.hits) for each in halves]
        expected = None
        if statement and not is_far(floors[0], self._settings, self._samples.spp):
            (picture,) = self.finish()
            measures = {
                name: measure_errors(first, second, picture, curve, self.hits, objects=objects)
                for name, curve, objects in _METRICS
            }
            floor, expected = statement.state(measures, len(picture), self._samples.spp)
            floors = [floor]
        return MeasuredLook(
            floor=floors[0],
            part_floors=dict(zip(names, floors[1:], strict=False)),
            light_floors=floors[1 + len(names) :],
            expected=expected,
            changes=self._changes.since([_half(pair) for pair in pairs]),
        )

    def finish(self) -> NDArray[np.float32]:
        if self._picture is None:
            self._picture = self._filtered_picture()
        return self._picture

    def _filtered_picture(self) -> NDArray[np.float32]:
        raw = self._means.mean()
        error = self._means.standard_error()
        parts = self._denoise(raw, self._settings.denoiser)
        if error is None or self._settings.denoiser == "off":
            return parts
        corrected = keep_converged(parts, raw, error)
        return np.stack([with_mean_of(*pair) for pair in zip(corrected, raw, strict=True)])

    def _denoise(self, pictures: Pictures, quality: Filtered) -> Pictures:
        require_bounded(float(pictures.max()))
        if quality == "off":
            return pictures
        names = self._settings.part_names
        filtered = [
            denoise(picture, self._features.of_part(name), quality)
            for picture, name in to_filter(list(pictures), names)
        ]

        def with_means(pairs: Sequence[tuple[Pictures, Pictures]]) -> list[Pictures]:
            return [with_mean_of(*pair) for pair in pairs]

        return np.stack(put_together(list(pictures), filtered, names, with_means, _shares_of))


class HostMeans:
    """Means of the samples of a view as they are now, read back once."""

    def __init__(self, samples: DualBuffer) -> None:
        self._samples = samples
        self._totals = [np.concatenate([each.read() for each in sums]) for sums in samples.sums]
        require_finite(int((~np.isfinite(self._totals).all(axis=(0, 1, -1))).sum()))

    def half_means(self) -> list[Pictures]:
        """Return the mean of each half, [P, R, R, 3]."""
        return [mean.astype(np.float32) for mean in self._means()]

    def mean(self) -> Pictures:
        """Return the mean of both halves, [P, R, R, 3].

        They weigh the same even where one has more samples: what one half is given goes by the
        other's, and weights by it would make the sum depend on itself
        (pipeline.renders.samples).
        """
        first, second = self._means()
        return ((first + second) / 2).astype(np.float32)

    def standard_error(self) -> NDArray[np.float64] | None:
        """Return that of the grey value of `mean`, [R, R], from the spread between all passes.

        It is infinite where there are fewer than LEAST_PASSES. None if there are several tracers,
        whose passes are not added.
        """
        samples = self._samples
        if len(samples.sums[0]) > 1:
            return None
        greys = np.stack([mean.sum(axis=0).mean(axis=-1) for mean in self._means()])
        spp = np.stack([samples.spp_of(half) for half in range(2)])
        mean = greys.mean(axis=0)
        count = samples.count_of(0) + samples.count_of(1)
        # Passes of n samples have the variance v / n, and the mean of a half of N has v / N.
        spread = (self._squares - spp * mean * (2 * greys - mean)).sum(axis=0)
        variance = np.maximum(spread, 0) / (count - 1)
        error = np.sqrt(variance * (1 / spp).sum(axis=0) / 4)
        return np.where(count < LEAST_PASSES, np.inf, error)

    @functools.cached_property
    def _squares(self) -> NDArray[np.float64]:
        return np.stack([tracers[0].read_squares() for tracers in self._samples.sums])

    def _means(self) -> list[NDArray[np.float64]]:
        spp = [self._samples.spp_of(half)[..., None] for half in range(2)]
        return [total / each for total, each in zip(self._totals, spp, strict=True)]


class LogChanges:
    """How much the halves change from look to look, as `MeasuredLook.changes`."""

    def __init__(self) -> None:
        self._before: Sequence[NDArray[np.float64]] = []

    def since(self, halves: Sequence[Half]) -> list[NDArray[np.float64]]:
        """Return the changes of halves since the last call."""
        logs = [log10_radiance(half.denoised_rgb.astype(np.float64)) for half in halves]
        pairs = zip(logs, self._before or logs, strict=True)
        self._before = logs
        return [tile_means(np.square(log - before).mean(axis=-1)) for log, before in pairs]


def _half(pair: tuple[Pictures, Pictures]) -> Half:
    """Return a half from its pictures [P, R, R, 3], raw and denoised, which are added."""
    return Half(raw_rgb=pair[0].sum(axis=0), denoised_rgb=pair[1].sum(axis=0))


def _shares_of(parts: Sequence[Pictures]) -> Sequence[Pictures]:
    """Return what share of their sum each of P parts [R, R, 3] is: equal ones where all are 0."""
    parts_rgb = np.stack(parts)
    total = parts_rgb.sum(axis=0, dtype=np.float64)
    equal = np.full(parts_rgb.shape, 1 / len(parts_rgb))
    shares = np.divide(parts_rgb, total, out=equal, where=total > 0).astype(np.float32)
    return list(shares)
