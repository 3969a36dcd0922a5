"""Adaptive sampling: chooses the tiles that get more samples, those that still change most.

Where a half of the samples grew from m to n of them per pixel, its denoised picture changed by d in
log10(1 + radiance). If the variance there is v / n, then d^2 is v (1 / m - 1 / n) on average: each
tile's v is read off two measurements. The error of a denoised picture falls much slower than 1 / n,
so the samples of a tile are made proportional to v^(1/3): on other scenes than those that judged
it, 1/3 spent them better than 1/2 and 1 did.

A half never chooses for itself. What one half is given goes by what the *other* half saw: the
samples of a half are then independent of how many it is given, and its mean stays unbiased. Had it
a say itself, tiles in which it found rare light by luck would be diluted, and the rest never
looked at again. Later choices go by pictures whose own samples the first one chose; what that
leaves is below what the tests can see.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.samples import DualBuffer
from pipeline.renders.settings import PASS_SPP, Filtered

TILE_PX = 8
"""Pixels across a tile; the widths of pictures are multiples of it."""

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
        self._seen: list[NDArray[np.int64]] = []
        self._variance: list[NDArray[np.float64]] = []
        self._filter: Filtered | None = None

    def learn(
        self, changes: Sequence[NDArray[np.float64]], samples: DualBuffer, quality: Filtered
    ) -> None:
        """Look at both halves as they are now, denoised by a filter of this quality.

        Args:
            changes: of each half, [T, T] mean squared change of its log radiance since the look
                before; anything at the first.
            samples: what is there.
            quality: of the filter. What changes with it says nothing of the samples: after that
                nothing new is known.
        """
        seen = [spp_of_tiles(samples, half) for half in range(len(changes))]
        if self._seen and quality == self._filter:
            known = self._variance or [np.zeros_like(self._weight)] * 2
            self._variance = [
                _variance(*each) for each in zip(changes, self._seen, seen, known, strict=True)
            ]
        self._seen = seen
        self._filter = quality

    def passes(self, samples: DualBuffer, mean_spp: int) -> list[NDArray[np.int64]] | None:
        """Return how many more passes each pixel of each half gets, [R, R]; None: all alike.

        Args:
            samples: what is there, as it was when `learn` was called last.
            mean_spp: samples per pixel that are wanted, both halves together.
        """
        more = mean_spp - samples.spp
        started = self._variance and self._seen[0].min() >= _PASS
        if not started or more < 2 * _PASS:
            return None
        return [
            of_pixels(passes_of_tiles(other_variance, spp, self._weight, more / 2))
            for other_variance, spp in zip(self._variance[::-1], self._seen, strict=True)
        ]


def _variance(
    change: NDArray[np.float64],
    spp_before: NDArray[np.int64],
    spp: NDArray[np.int64],
    known: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the variance of one sample, [T, T], by two looks; `known` where nothing was added."""
    grown = spp > spp_before
    less = np.where(grown, 1 / spp_before - 1 / spp, 1)
    return np.where(grown, _smooth(change) / less, known)


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


def spp_of_tiles(samples: DualBuffer, half: int) -> NDArray[np.int64]:
    """Return the samples per pixel of one half, [T, T]."""
    return samples.spp_of(half)[::TILE_PX, ::TILE_PX].copy()


def tile_means(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the means over the tiles [T, T] of a picture [R, R]."""
    across = len(values) // TILE_PX
    means: NDArray[np.float64] = values.reshape(across, TILE_PX, across, TILE_PX).mean(axis=(1, 3))
    return means


def of_pixels(tiles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return for each pixel [R, R] what its tile has."""
    return tiles.repeat(TILE_PX, axis=0).repeat(TILE_PX, axis=1)


def _smooth(tiles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the tiles, each mixed with its eight neighbours (the edge's own beyond the edge)."""
    across = len(tiles)
    for axis in range(2):
        wide = np.pad(tiles, [(1, 1) if axis == n else (0, 0) for n in range(2)], mode="edge")
        rows = [wide.take(range(k, k + across), axis) * part for k, part in enumerate(_SMOOTHING)]
        tiles = np.sum(rows, axis=0)
    return tiles
