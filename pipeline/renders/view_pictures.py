"""Rules of pictures: which pixels the denoiser may not change, what it filters, and sums of that.

The denoiser may not change converged pixels, nor the mean brightness of a picture. It takes single
bright pixels for noise. A glint that many passes agree on is none: where the raw mean stands out of
the denoised picture by several of its own standard errors, the raw mean is right and is kept. The
denoiser also spreads glints into dark neighbours, of 0.1 that became 22 in one scene; dark pixels
are kept too where they and their neighbours have converged.

What is left of light that the denoiser removed is given back by factors, so that on average a
picture is exactly as bright as its samples, which are unbiased. Without it pictures of caustics
came out darker, by 1.3 % on average over the views of 16 scenes at 256 samples and by up to 17 % at
32.
"""

import functools
import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from pipeline.renders.noise_floor import clamped_radiance
from pipeline.renders.samples import by_tiles
from storage.conventions import HALF_FLOAT_MAX, log10_radiance
from storage.errors import Rejected
from storage.records.sample import PictureErrors

LEAST_PASSES = 10
"""Passes from which on their spread says how far a pixel has converged: of fewer, 4 standard errors
are reached by chance too often."""

STANDARD_ERRORS = 4.0
"""A pixel stands out by so many."""

STANDS_OUT = 1.5
"""It is also brighter than this multiple of the denoised one: smaller differences are not what the
denoiser takes for outliers, and the denoised pixel has less noise."""

DARKER = 4.0
"""A dark pixel is kept where the denoised one is brighter than this multiple of it. Pixels that
rare light has not met yet look converged as well: with 1.5 and without looking at neighbours,
pictures of 20 scenes lost 0.5 to 1.3 dB on average."""

GLINT = 4.0
"""Denoised radiance from which on a pixel is the glint of a lamp: far beyond white. What glints
have lost goes back to them: one factor for all pixels made RenderFormer's cbox-bunny 3 % too bright
everywhere, for light that 20 pixels had lost, which was 1.4 dB in linear light."""

MOST_APART = 1.5
"""The glints and the rest get factors of their own where both lie between this and its inverse:
farther ones come from single bright samples, and then one factor for all pixels errs least."""

MAX_RAW = 1e13
"""Raw pixels from this radiance on are refused: half floats could not hold the picture even if the
denoiser spread one of them over 8192 x 8192 pixels. From about 5e36 on the denoiser returns black,
which would hide the overflow."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredLook:
    """Measurements on the samples of a view at one time."""

    floor: PictureErrors
    part_floors: Mapping[str, PictureErrors]
    """Stated error of each part that is stored, of all lights together."""
    light_floors: Sequence[PictureErrors]
    """Stated error of each light whose picture is stored; empty where they are together."""
    expected: PictureErrors | None = None
    """Error of the picture that is as often better as worse, where the stated one is calibrated
    (pipeline.renders.calibrated_error); None where it is the bound of noise_floor."""
    changes: Sequence[NDArray[np.float64]]
    """Mean squared change of the denoised log radiance of each tile since the look before, [T, T]
    for each half; the first look has none that means anything."""


class Pixels:
    """Operations on pictures [R, R, 3], single or double, and on values of pixels [R, R], in numpy.

    Kernels write them unlike. All that must stay in numpy for published sets is here: sums in
    another order change last digits.
    """

    log10 = staticmethod(log10_radiance)
    clamp = staticmethod(clamped_radiance)
    sqrt: Any = np.sqrt
    maximum: Any = np.maximum
    single: Any = staticmethod(functools.partial(np.asarray, dtype=np.float32))
    double: Any = staticmethod(functools.partial(np.asarray, dtype=np.float64))
    channel_mean: Any = staticmethod(functools.partial(np.mean, axis=-1))
    brightest: Any = staticmethod(functools.partial(np.max, axis=-1))
    """Largest channel of each pixel."""

    def flat(self, color: Any) -> Any:
        """Return a picture as the denoiser takes it."""
        return color

    def select(self, mask: Any, first: Any, second: Any) -> Any:
        return np.where(mask[..., None] if np.ndim(first) > mask.ndim else mask, first, second)

    def channels(self, color: Any) -> Sequence[Any]:
        return list(np.moveaxis(color, -1, 0))

    def is_finite(self, color: Any) -> Any:
        return np.isfinite(color).all(axis=-1)

    def mean(self, total: Any, count: Any) -> Any:
        """Return the color of pixels whose sum is `total`."""
        return total / count[..., None]

    def difference(self, first: Any, second: Any) -> Any:
        """Return the difference of single colors in double precision."""
        return (first - second).astype(np.float64)

    def error_around(self, squared_error: Any) -> Any:
        """Return the root of the mean over 3 x 3 pixels."""
        edge = np.pad(np.sqrt(squared_error) ** 2, 1, "edge")
        return np.sqrt(sliding_window_view(edge, (3, 3)).mean((2, 3)))

    def clean(self, inputs: Any, outputs: Any, guides: Any, *, are_lights: bool) -> list[Any]:
        """Return what the filter made of inputs, without what it paints where no light is.

        Args:
            inputs: what `to_filter` yields.
            outputs: pictures by the filter.
            guides: albedo and normal by the name of a part.
            are_lights: whether lights alone are among them.
        """
        return list(outputs)

    def with_means(self, pairs: Sequence[tuple[Any, Any]]) -> list[Any]:
        """Return pictures (denoised, raw) with the mean of the raw ones."""
        return [with_mean_of(*pair) for pair in pairs]

    def shares(self, parts: Sequence[Any]) -> list[Any]:
        """Return what share of their sum each of some pictures is: equal ones where all are 0."""
        doubles = [self.double(part) for part in parts]
        total = add_up(doubles)
        with np.errstate(invalid="ignore"):  # 0 / 0, which is not selected
            shares = [self.select(total > 0, part / total, 1 / len(parts)) for part in doubles]
        return [self.single(share) for share in shares]

    def tile_sums(self, values: Sequence[Any]) -> Sequence[Any]:
        """Return the sums over tiles of each of some values of pixels."""
        return [by_tiles(each).sum(axis=(1, 3)).ravel() for each in values]

    def totals_of_tiles(self, values: Sequence[Any]) -> Any:
        """Return the sum over all tiles of each of some values of tiles."""
        return np.array([each.sum() for each in values])

    def one_row(
        self, totals: Sequence[Any], adds: Sequence[Any], most: Sequence[Any], logs: Sequence[Any]
    ) -> Any:
        """Return totals, the sums of `adds` over tiles and the greatest of `most` in them, flat.

        Args:
            totals: rows of numbers.
            adds, most: values of pixels.
            logs: pictures that are worked out with them, where that is not done yet.
        """
        greatest = [by_tiles(each).max(axis=(1, 3)).ravel() for each in most]
        return np.concatenate([*totals, *self.tile_sums(adds), *greatest])


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


def require_finite(num_broken: int) -> None:
    """Raise Rejected("nonfinite_radiance") where so many pixels have raw samples without end."""
    if num_broken:
        raise Rejected("nonfinite_radiance", f"{num_broken} pixels of raw samples")


def require_bounded(brightest: float) -> None:
    """Raise Rejected("radiance_overflow") where the denoiser would hide what is too bright."""
    if brightest >= MAX_RAW:
        raise Rejected("radiance_overflow", f"a raw pixel of radiance {brightest:.3g}")


def representable(radiance_rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return radiance that half floats can hold; raises Rejected("radiance_overflow") else."""
    if radiance_rgb.max() >= HALF_FLOAT_MAX:
        raise Rejected("radiance_overflow", f"a pixel of radiance {radiance_rgb.max():.3g}")
    return radiance_rgb


def to_filter(pictures: Sequence[Any], names: Sequence[str]) -> Iterator[tuple[Any, str]]:
    """Yield the pictures that a denoiser is asked for, each with the name of its part.

    Parts are denoised apart, each as a picture of its own. In five scenes direct light, whose
    shadows the noise of all other light would hide, was 4 dB better on average than its share of
    one denoised picture, indirect light 0.2 dB worse, and the sum 0.4 dB better (study S9).
    """
    for part, name in enumerate(names or ("",)):
        lights = pictures[part :: max(1, len(names))]
        yield add_up(lights), name
        if len(lights) > 1:
            yield from ((light, name) for light in lights)


Group = tuple[int, int | None, int | None]
"""Pictures of a view that are summed, as the numbers of a slice."""


def floor_groups(num_pictures: int, names: Sequence[str], *, per_light: bool) -> tuple[Group, ...]:
    """Return the sums of pictures whose error is stated: all, each part, then each light."""
    every = max(1, len(names))
    parts: list[Group] = [(part, None, every) for part in range(len(names))]
    starts = range(0, num_pictures, every) if per_light else ()
    return ((0, None, None), *parts, *((start, start + every, None) for start in starts))


def put_together(
    pictures: Sequence[Any],
    filtered: Sequence[Any],
    names: Sequence[str],
    pixels: Pixels,
) -> list[Any]:
    """Return the pictures without noise, from those that `to_filter` yields as they were denoised.

    Lights apart are shares of one denoised picture, pixel by pixel and channel by channel: of all
    light together, in proportion to what each is when it is denoised alone. The sum of pictures
    that were denoised alone carries the bias of each: in four scenes it was 1.7 to 5.2 dB worse
    than this one, and claimed a floor up to 5.9 dB better than the truth (study S8).

    Args:
        pictures: as they were traced.
        filtered: one for each that `to_filter` yields.
        pixels: operations on all of these.
    """
    count = max(1, len(names))
    num_lights = len(pictures) // count
    every = 1 if num_lights == 1 else 1 + num_lights
    raws = [add_up(pictures[part::count]) for part in range(count)]
    together = pixels.with_means(list(zip(filtered[::every], raws, strict=True)))
    denoised = list(pictures)
    for part, picture in enumerate(together):
        alone = filtered[part * every + 1 : (part + 1) * every]
        shares = pixels.shares(alone) if alone else []
        denoised[part::count] = [picture * share for share in shares] or [picture]
    return denoised


def add_up(pictures: Sequence[Any]) -> Any:
    return functools.reduce(operator.add, pictures)
