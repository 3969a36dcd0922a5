"""`HostPictures`: the arithmetic of a view in numpy, on sums that are read back.

All that must stay in numpy for published sets is here: sums in another order change last digits.
Sets choose it by their render settings (`arithmetic`). All others take
pipeline.renders.device_pictures, of which this is the tests' oracle.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from pipeline.renders.noise_floor import clamped_radiance
from pipeline.renders.pictures import (
    LookNumbers,
    Pictures,
    PixelNumbers,
    Sums,
    broken_pixels,
    finish_pictures,
    means,
    measure_pixels,
)
from pipeline.renders.samples import DualBuffer, by_tiles
from pipeline.renders.settings import Filtered, RenderSettings
from pipeline.renders.tracer import PixelCamera, Tracer
from pipeline.renders.view_pictures import (
    GLINT,
    MOST_APART,
    add_up,
    require_bounded,
    require_finite,
    to_filter,
)
from storage.conventions import log10_radiance
from storage.denoiser import denoise


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


class _NumpyPixels:
    """`Pixels` of pictures [R, R, 3] and of values [R, R]."""

    log10 = staticmethod(log10_radiance)
    clamp = staticmethod(clamped_radiance)
    sqrt = np.sqrt
    maximum = np.maximum

    def single(self, color: Any) -> Any:
        return color.astype(np.float32)

    def double(self, color: Any) -> Any:
        return color.astype(np.float64)

    def select(self, mask: Any, first: Any, second: Any) -> Any:
        return np.where(mask[..., None] if np.ndim(first) > mask.ndim else mask, first, second)

    def channels(self, color: Any) -> Sequence[Any]:
        return list(np.moveaxis(color, -1, 0))

    def channel_mean(self, color: Any) -> Any:
        return color.mean(axis=-1)

    def brightest(self, color: Any) -> Any:
        return color.max(axis=-1)

    def is_finite(self, color: Any) -> Any:
        return np.isfinite(color).all(axis=-1)

    def mean(self, total: Any, count: Any) -> Any:
        return total / count[..., None]

    def difference(self, first: Any, second: Any) -> Any:
        return (first - second).astype(np.float64)

    def are_equal(self, first: Any, second: Any) -> bool:
        return np.array_equal(first, second)

    def error_around(self, squared_error: Any) -> Any:
        edge = np.pad(np.sqrt(squared_error) ** 2, 1, "edge")
        return np.sqrt(sliding_window_view(edge, (3, 3)).mean((2, 3)))

    def clean(self, inputs: Any, outputs: Any, guides: Any, *, are_lights: bool) -> list[Any]:
        return list(outputs)

    def with_means(self, pairs: Sequence[tuple[Any, Any]]) -> list[Any]:
        return [with_mean_of(*pair) for pair in pairs]

    def shares(self, parts: Sequence[Any]) -> list[Any]:
        parts_rgb = np.stack(parts)
        total = parts_rgb.sum(axis=0, dtype=np.float64)
        equal = np.full(parts_rgb.shape, 1 / len(parts_rgb))
        return list(np.divide(parts_rgb, total, out=equal, where=total > 0).astype(np.float32))

    def tile_sums(self, values: Sequence[Any]) -> Sequence[Any]:
        return [by_tiles(each).sum(axis=(1, 3)).ravel() for each in values]

    def totals_of_tiles(self, values: Sequence[Any]) -> Any:
        return np.array([each.sum() for each in values])


NUMPY = _NumpyPixels()
"""Pixels of `HostPictures`."""


def read_sums(samples: DualBuffer, *, squares: bool = False) -> Sums:
    """Return the sums of a view, with their squares or 0; raises Rejected as `Pictures.look`."""
    shape = samples.spp_of(0).shape
    sums = [
        [
            [*each.read(), each.read_squares() if squares else np.zeros(shape), spp, passes]
            for each in samples.sums[half]
        ]
        for half, spp, passes in ((n, samples.spp_of(n), samples.count_of(n)) for n in range(2))
    ]
    require_finite(int(broken_pixels(sums, NUMPY).sum()))
    return sums


def add_numbers(measured: PixelNumbers) -> LookNumbers:
    """Return the numbers of pixels by tile and in all."""
    most = [by_tiles(each).max(axis=(1, 3)).ravel() for each in measured.most]
    return LookNumbers(
        totals=np.array(measured.totals).reshape(-1, 6),
        adds=np.array(NUMPY.tile_sums(measured.adds)),
        sums=np.array([each.sum() for each in measured.adds]),
        most=np.array(most, np.float64),
        logs=measured.logs,
    )


class HostPictures(Pictures):
    """See `Pictures` for the meaning of its methods."""

    def __init__(
        self, samples: DualBuffer, tracer: Tracer, camera: PixelCamera, settings: RenderSettings
    ) -> None:
        self._features = tracer.features(camera, spp=settings.aux_spp)
        visible: NDArray[np.bool_] = np.any(self._features.normal != 0, axis=-1)
        super().__init__(samples, settings, tracer.hits(camera), visible, logs=(0.0, 0.0))

    @staticmethod
    def mean_radiance(samples: DualBuffer) -> float:
        (pictures,) = means(read_sums(samples), NUMPY, of_both=True)
        return float(add_up(pictures).mean(dtype=np.float64))

    def finish(self) -> NDArray[np.float32]:
        if self._picture is None:
            filtered = self._denoise_raws(self._settings.denoiser, of_both=True)
            self._picture = finish_pictures(self._sums, filtered, None, NUMPY, self._names)
        return np.stack(self._picture)

    def _begin_look(self) -> None:
        self._sums = read_sums(self._samples, squares=len(self._samples.sums[0]) == 1)

    def _finished(self) -> Any:
        return self.finish()[0]

    def _denoise_raws(self, quality: Filtered, *, of_both: bool) -> Sequence[Any]:
        raws = means(self._sums, NUMPY, of_both=of_both)
        require_bounded(float(np.max(raws)))
        if quality == "off":
            return []
        return [
            [
                denoise(picture, self._features.of_part(name), quality)
                for picture, name in to_filter(pictures, self._names)
            ]
            for pictures in raws
        ]

    def _numbers(self, finished: Any) -> LookNumbers:
        guides, names, groups = None, self._names, self._groups()
        measured = measure_pixels(
            self._sums,
            self._filtered,
            guides,
            self.hits,
            self._logs,
            finished,
            NUMPY,
            names,
            groups,
        )
        return add_numbers(measured)
