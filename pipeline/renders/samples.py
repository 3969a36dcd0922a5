"""The samples of one view: two growing halves that share nothing, of each light apart or of all.

Adaptive sampling chooses the tiles that get more samples, those that still change most. Where a
half of the samples grew from m to n of them per pixel, its denoised picture changed by d in
log10(1 + radiance). If the variance there is v / n, then d^2 is v (1 / m - 1 / n) on average: each
tile's v is read off two measurements. The error of a denoised picture falls much slower than 1 / n,
so the samples of a tile are made proportional to v^(1/3): on other scenes than those that judged
it, 1/3 spent them better than 1/2 and 1 did.

A half never chooses for itself. What one half is given goes by what the *other* half saw: the
samples of a half are then independent of how many it is given, and its mean stays unbiased. Had it
a say itself, tiles in which it found rare light by luck would be diluted, and the rest never
looked at again. Later choices go by pictures whose own samples the first one chose; what that
leaves is below what the tests can see.

Sampling stops at all targets of a view, or at the cap. Targets and measured floors go by the name
of their metric (storage.metrics). One view may need many more samples by one metric than by
another: the linear PSNR weighs bright pixels more, up to radiance 1, and empty background raises
every mean but the one over objects. So each target that is missed is extrapolated by what a
doubling of the samples bought in its own metric, and the one that needs most samples governs.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.noise_floor import BLOCK_PX
from pipeline.renders.settings import PASS_SPP, Filtered
from pipeline.renders.tracer import Chosen, PixelCamera
from storage.seeds import seed_for

if TYPE_CHECKING:
    from pipeline.renders.vector_tracer import VectorTracer


class DualBuffer:
    """Two growing sums of passes of one view, with no sample in common.

    There are P pictures: those of one tracer of all light, or those of the tracers of each emitter
    alone, one after another. The passes of all tracers have the same seeds, hence the same camera
    rays.
    """

    def __init__(
        self,
        tracers: Sequence["VectorTracer"],
        camera: PixelCamera,
        seed: int,
        *,
        first_spp: int,
        max_spp: int,
        light_seed: int | None = None,
    ) -> None:
        """Begin a view without any sample.

        Args:
            seed: of this view alone.
            first_spp: samples per pixel of the first measurement, both halves together.
            max_spp: the most that will be asked for.
            light_seed: of the light paths, which other views may have too; None: `seed`.
        """
        self._seed = seed
        self._light_seed = light_seed
        self._first = first_spp // 2
        self._most = max_spp // 2
        self.sums = [[tracer.pass_sum(camera) for tracer in tracers] for _ in range(2)]
        """Of each half, and in it of each tracer."""
        self.is_guided = False
        """True once a pass may be guided."""
        self.spp_by_half = np.zeros((2, camera.resolution, camera.resolution), np.int64)
        """[2, R, R] samples of each pixel in each half."""
        self._passes = 0
        self.counted = np.ones(self.spp_by_half.shape[1:], bool)
        """[R, R] pixels over which `spp` is a mean: at first all."""

    @property
    def spp(self) -> int:
        """Samples per pixel so far, both halves together: the mean over the counted pixels."""
        return int(self.spp_by_half.sum(axis=0).mean(where=self.counted))

    @property
    def pass_spp(self) -> int:
        """Samples per pixel of the next pass of one half: the best that leads to round numbers.

        It divides what is there already and what is left, so that a half which has 64 samples goes
        on in passes of 64, however small its first ones were.
        """
        done = int(self.spp_by_half[0].max())
        remaining = (self._most if done else self._first) - done
        return next(size for size in PASS_SPP if done % size == 0 and remaining % size == 0)

    def passes_to(self, spp: int) -> Iterator[None]:
        """Add passes to both halves until there are `spp` samples at least, yielding after each.

        Nothing waits for a pass to be finished before a mean is asked for.
        """
        while self.spp < spp:
            size = self.pass_spp
            for half in range(2):
                self._add(half, size, None)
                yield
            self._passes += 1

    def passes_over(self, more: Sequence[NDArray[np.int64]]) -> Iterator[None]:
        """Add the best passes to some pixels, yielding after each.

        Args:
            more: for each half, how many more of them each pixel gets, [R, R].
        """
        for number in range(max(int(passes.max()) for passes in more)):
            for half, passes in enumerate(more):
                if (passes > number).any():
                    self._add(half, PASS_SPP[0], passes > number)
                    yield
            self._passes += 1

    def _add(self, half: int, size: int, chosen: Chosen) -> None:
        seed = seed_for(self._seed, "pass", self._passes, half)
        light_seed = self._light_seed
        if light_seed is not None:
            light_seed = seed_for(light_seed, "pass", self._passes, half)
        for tracer in self.sums[half]:
            tracer.add(seed=seed, spp=size, chosen=chosen, light_seed=light_seed)
        self.spp_by_half[half] += size if chosen is None else size * chosen

    def guide(self) -> None:
        """Let the passes from now on be guided (pipeline.renders.guide_table)."""
        self.is_guided = True
        for tracers in self.sums:
            for tracer in tracers:
                tracer.guide()


TILE_PX = BLOCK_PX
"""Pixels across a tile; one order of pixels serves both. Widths of pictures are multiples of it."""

_PASS = PASS_SPP[0]
"""Samples per pixel of a pass over tiles; there is no choice before a half has as many."""

_LEAST_SHARE = 1e-3
"""Of the mean variance, added to every tile's: none is taken for perfect."""

_MOST = 2.0
"""A tile gets at most this many times the mean that is wanted: what one measurement says of it may
be wrong, and the next one says it again."""

_SMOOTHING = np.array([0.25, 0.5, 0.25])


class TileChoice:
    """Chooses the next passes of each half by the changes of the other one."""

    def __init__(self, visible: NDArray[np.bool_]) -> None:
        """Begin with nothing seen.

        Args:
            visible: [R, R] pixels that may have light at all.
        """
        self._weight = tile_means(visible.astype(np.float64))
        self._seen: NDArray[np.int64] | None = None
        self._variance: NDArray[np.float64] | None = None
        """[2, T, T] of one sample, by two looks; a tile that got none keeps what was known."""
        self._filter: Filtered | None = None

    def learn(
        self, changes: Sequence[NDArray[np.float64]], samples: DualBuffer, quality: Filtered
    ) -> None:
        """Look at both halves as they are now, denoised by a filter of this quality.

        Args:
            changes: of each half, [T, T] mean squared change of its log radiance since the look
                before; anything at the first.
            quality: of the filter. What changes with it says nothing of the samples: after that
                nothing new is known.
        """
        seen = samples.spp_by_half[:, ::TILE_PX, ::TILE_PX].copy()
        if self._seen is not None and quality == self._filter:
            grown = seen > self._seen
            less = np.where(grown, 1 / self._seen - 1 / seen, 1)
            known = 0.0 if self._variance is None else self._variance
            self._variance = np.where(grown, np.stack([*map(_smooth, changes)]) / less, known)
        self._seen = seen
        self._filter = quality

    def passes(self, samples: DualBuffer, mean_spp: int) -> list[NDArray[np.int64]] | None:
        """Return how many more passes each pixel of each half gets, [R, R]; None: all alike.

        Args:
            samples: what is there, as it was when `learn` was called last.
            mean_spp: samples per pixel that are wanted, both halves together.
        """
        more = mean_spp - samples.spp
        if self._variance is None or self._seen is None:
            return None
        if self._seen[0].min() < _PASS or more < 2 * _PASS:
            return None
        of_tiles = [
            passes_of_tiles(other_variance, spp, self._weight, more / 2)
            for other_variance, spp in zip(self._variance[::-1], self._seen, strict=True)
        ]
        return [each.repeat(TILE_PX, axis=0).repeat(TILE_PX, axis=1) for each in of_tiles]


def passes_of_tiles(
    variance: NDArray[np.float64],
    spp: NDArray[np.int64],
    weight: NDArray[np.float64],
    more: float,
) -> NDArray[np.int64]:
    """Return how many more passes each tile gets, [T, T]: the fewest that make the mean grow so.

    Args:
        variance: [T, T] of one sample, of the other half.
        spp: [T, T] samples per pixel that are there.
        weight: [T, T] of each tile in the mean. Tiles without weight get nothing.
        more: by how many samples per pixel the mean shall grow, _PASS at least.
    """
    weight = weight / weight.sum()
    target_spp = (weight * spp).sum() + more
    mean = (variance * weight).sum()
    share = np.where(weight > 0, np.cbrt(variance + _LEAST_SHARE * mean) if mean else 1.0, 0)
    room = np.maximum((_MOST * target_spp - spp) // _PASS, 0)

    def passes(factor: float) -> NDArray[np.float64]:
        return np.clip(np.floor((factor * share - spp) / _PASS + 0.5), 0, room)

    low = 0.0
    high = 2 * _MOST * target_spp / share[weight > 0].min()
    for _ in range(60):  # bisection, to the precision of float64
        middle = (low + high) / 2
        suffices = (weight * (spp + _PASS * passes(middle))).sum() >= target_spp
        low, high = (low, middle) if suffices else (middle, high)
    return passes(high).astype(np.int64)


def by_tiles(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a picture [R, R, ...] as [T, TILE_PX, T, TILE_PX, ...]: axes 1 and 3 are in a tile."""
    across = len(values) // TILE_PX
    return values.reshape(across, TILE_PX, across, TILE_PX, *values.shape[2:])


def tile_means(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the means over the tiles [T, T, ...] of a picture [R, R, ...]."""
    means: NDArray[np.float64] = by_tiles(values).mean(axis=(1, 3))
    return means


def _smooth(tiles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the tiles, each mixed with its eight neighbours (the edge's own beyond the edge)."""
    across = len(tiles)
    for axis in range(2):
        wide = np.pad(tiles, [(1, 1) if axis == n else (0, 0) for n in range(2)], mode="edge")
        rows = [wide.take(range(k, k + across), axis) * part for k, part in enumerate(_SMOOTHING)]
        tiles = np.sum(rows, axis=0)
    return tiles


Floors = Mapping[str, float]
"""Decibels by metric."""

Measured = Sequence[tuple[int, Floors]]
"""Samples per pixel and the floors that were measured then, in order."""

_DB_PER_DOUBLING = 1.2
"""The true error falls by 0.9 to 2.0 dB per doubling of the samples, not by 3. This low guess is
used until the view itself has been measured twice."""

_SLOWEST_DB = 0.6
"""Smallest gain per doubling that is believed: two floors of a view are noisy."""

_FASTEST_DB = 3.0
"""Largest gain per doubling that is believed."""

_MAX_GROWTH = 2.0
"""The samples grow at most by this between two measurements: each of them is a new choice of tiles.
With 4 half of what these gain was lost."""


def gaps_db(targets_db: Floors, floors_db: Floors) -> dict[str, float]:
    """Return by how many dB each target is missed, by metric; without those that are reached."""
    gaps = {metric: target_db - floors_db[metric] for metric, target_db in targets_db.items()}
    return {metric: gap_db for metric, gap_db in gaps.items() if gap_db > 0}


def next_spp(spp: int, expected: int, step: int) -> int:
    """Return the samples at which floors are measured next, of `expected_spp` after `spp`."""
    growth = max(step * math.ceil(spp * _MAX_GROWTH / step), spp + step)
    return min(expected, growth)


def expected_spp(measured: Measured, targets_db: Floors, *, step: int, max_spp: int) -> int:
    """Return the number of samples that should reach all targets, or the cap.

    Args:
        measured: of this view so far; the last floors miss a target, and their samples are a
            multiple of `step` below the cap.
        targets_db: stated errors to reach, in dB by metric.
        step: samples per pixel that one pass adds, both halves together.
        max_spp: the cap, a multiple of `step`.
    """
    spp, floors_db = measured[-1]
    gaps = gaps_db(targets_db, floors_db)
    needed_doublings = max(gap_db / slope_db(measured, metric) for metric, gap_db in gaps.items())
    doublings = min(needed_doublings, math.log2(max_spp / spp) + 1)
    target_spp = step * math.ceil(spp * 2**doublings / step)
    return min(max_spp, max(target_spp, spp + step))


def slope_db(measured: Measured, metric: str) -> float:
    """Return what a doubling of the samples buys in this view, in dB, from its last two floors.

    Args:
        measured: of this view so far; one measurement is enough.
        metric: whose floors are compared.
    """
    if len(measured) < 2:
        return _DB_PER_DOUBLING
    (before, lower_db), (now, upper_db) = measured[-2:]
    gain_db = upper_db[metric] - lower_db[metric]
    return min(max(gain_db / math.log2(now / before), _SLOWEST_DB), _FASTEST_DB)
