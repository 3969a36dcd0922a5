"""`ViewPictures`: means, errors and denoised pictures of a view, in numpy or on the device."""

import functools
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.noise_floor import MeasuredFloor
from pipeline.renders.samples import DualBuffer
from pipeline.renders.settings import Filtered
from storage.errors import Rejected

MAX_RAW = 1e13
"""Raw pixels from this radiance on are refused: half floats could not hold the picture even if the
denoiser spread one of them over 8192 x 8192 pixels. From about 5e36 on the denoiser returns black,
which would hide the overflow."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredLook:
    """Measurements on the samples of a view at one time."""

    floor: MeasuredFloor
    """Stated error of the picture."""
    part_floors: Mapping[str, MeasuredFloor]
    """Stated error of each part that is stored, of all lights together."""
    light_floors: Sequence[MeasuredFloor]
    """Stated error of each light whose picture is stored; empty where they are together."""
    expected: MeasuredFloor | None = None
    """Error of the picture that is as often better as worse, where the stated one is calibrated
    (pipeline.renders.calibrated_error); None where it is the bound of noise_floor."""
    changes: Sequence[NDArray[np.float64]]
    """Mean squared change of the denoised log radiance of each tile since the look before, [T, T]
    for each half; the first look has none that means anything."""


class ViewPictures(Protocol):
    """The pictures of one view, of samples that grow.

    There are P of them, of lights and of their parts: all parts of the first light come first.
    """

    hits: NDArray[np.bool_]
    """[R, R] true where `Tracer.hits` is."""
    visible: NDArray[np.bool_]
    """[R, R] pixels with a first surface, anywhere within the pixel; all of them if none has."""

    @staticmethod
    def mean_radiance(samples: DualBuffer) -> float:
        """Return the mean radiance of all pixels so far; raises as `look`."""

    def look(self, quality: Filtered) -> MeasuredLook:
        """Return what is measured now, with halves denoised by a filter of this quality.

        Raises:
            Rejected: "nonfinite_radiance" where a raw sample is not finite, "radiance_overflow".
        """

    def finish(self) -> NDArray[np.float32]:
        """Return the pictures of all samples of the last look, [P, R, R, 3]."""


def require_finite(num_broken: int) -> None:
    """Raise Rejected("nonfinite_radiance") where so many pixels have raw samples without end."""
    if num_broken:
        raise Rejected("nonfinite_radiance", f"{num_broken} pixels of raw samples")


def require_bounded(brightest: float) -> None:
    """Raise Rejected("radiance_overflow") where the denoiser would hide what is too bright."""
    if brightest >= MAX_RAW:
        raise Rejected("radiance_overflow", f"a raw pixel of radiance {brightest:.3g}")


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
    with_means_of: Callable[[Sequence[tuple[Any, Any]]], Sequence[Any]],
    shares_of: Callable[[Sequence[Any]], Sequence[Any]],
) -> list[Any]:
    """Return the pictures without noise, from those that `to_filter` yields as they were denoised.

    Lights apart are shares of one denoised picture, pixel by pixel and channel by channel: of all
    light together, in proportion to what each is when it is denoised alone. The sum of pictures
    that were denoised alone carries the bias of each: in four scenes it was 1.7 to 5.2 dB worse
    than this one, and claimed a floor up to 5.9 dB better than the truth (study S8).

    Args:
        pictures: as they were traced.
        filtered: one for each that `to_filter` yields.
        names: of the parts.
        with_means_of: gives pairs, denoised and raw, the mean brightness of the raw ones.
        shares_of: returns what share of their sum each of some pictures is.
    """
    count = max(1, len(names))
    num_lights = len(pictures) // count
    every = 1 if num_lights == 1 else 1 + num_lights
    raws = [add_up(pictures[part::count]) for part in range(count)]
    together = with_means_of(list(zip(filtered[::every], raws, strict=True)))
    denoised = list(pictures)
    for part, picture in enumerate(together):
        alone = filtered[part * every + 1 : (part + 1) * every]
        shares = shares_of(alone) if alone else []
        denoised[part::count] = [picture * share for share in shares] or [picture]
    return denoised


def add_up(pictures: Sequence[Any]) -> Any:
    """Return the sum of pictures, in their order."""
    return functools.reduce(operator.add, pictures)
