"""Learns the guide table of a scene from photons, once (after Jensen 1995).

Small cells have few photons. So cells that lie in one cube of space and face the same way share a
row, from small cubes to large ones: a cell takes the smallest that has enough photons, with a part
of what the next larger one says, for what the few have missed.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.guide_cells import GuideCells
from pipeline.renders.guide_table import BINS, ENTRIES, SIDE, GuideTable

_LEVELS = 4
"""Sizes of cubes: 1, 2, 4 and 8 times a cell."""

_LEAST_PHOTONS = 64
"""Fewest photons of a row."""

_MOST_ROWS = 2048
"""Most rows of one level, which bounds the table by 64 MB."""

_PARENT = 0.25
"""Part of a row that the next larger cube says."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Photons:
    """Photons that arrived by way of a narrow lobe."""

    cell: NDArray[np.int64]
    """[P] cell that each photon hit (`GuideCells`)."""
    bin: NDArray[np.int64]
    """[P] bin of the direction from which each photon came (`bin_of`)."""
    power: NDArray[np.float64]
    """[P] in any unit, above 0."""


def learn(cells: GuideCells, photons: Photons) -> GuideTable | None:
    """Return the guide table, or None if no cell got enough photons."""
    least = max(_LEAST_PHOTONS, math.ceil(len(photons.cell) / _MOST_ROWS))
    row_of_cell = np.zeros(len(cells.facing), np.int64)
    rows = np.zeros((1, BINS))
    for level in reversed(range(_LEVELS)):
        group = _groups(cells, cells.size_m * 2**level)
        large_groups = np.flatnonzero(
            np.bincount(group[photons.cell], minlength=group.max() + 1) >= least
        )
        place = np.full(group.max() + 1, -1)
        place[large_groups] = np.arange(len(large_groups))
        finer = _shares(_histograms(place[group], photons, len(large_groups)))
        parents = np.zeros(len(large_groups), np.int64)
        held = place[group] >= 0
        parents[place[group[held]]] = row_of_cell[held]
        known = (parents > 0)[:, None]
        finer = np.where(known, (1 - _PARENT) * finer + _PARENT * rows[parents], finer)
        row_of_cell = np.where(held, len(rows) + place[group], row_of_cell)
        rows = np.concatenate([rows, finer])
    used, row_of_cell = np.unique(np.append(row_of_cell, 0), return_inverse=True)
    if len(used) == 1:
        return None
    return GuideTable(cells, row_of_cell[:-1], apportion_entries(rows[used[1:]]))


def apportion_entries(shares: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return shares [N, BINS] as whole numbers that add up to ENTRIES; each row of shares to 1."""
    edges = np.rint(np.cumsum(shares, axis=1) * ENTRIES).astype(np.int64)
    return np.diff(edges, axis=1, prepend=0)


def _groups(cells: GuideCells, width_m: float) -> NDArray[np.int64]:
    """Return for each cell the number of its cube and facing, [C]."""
    cube = np.floor(cells.centres_m / width_m).astype(np.int64)
    _, group = np.unique(np.column_stack([cube, cells.facing]), axis=0, return_inverse=True)
    return group.ravel()


def _histograms(place: NDArray[np.int64], photons: Photons, count: int) -> NDArray[np.float64]:
    row = place[photons.cell]
    flat = row[row >= 0] * BINS + photons.bin[row >= 0]
    sums = np.bincount(flat, photons.power[row >= 0], minlength=count * BINS).astype(np.float64)
    return sums.reshape(count, SIDE, SIDE)


def _shares(histograms: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return each histogram blurred over its neighbours, with a sum of 1, [N, BINS]."""
    wide = np.pad(histograms, ((0, 0), (1, 1), (1, 1)), mode="edge")
    wide = wide[:, :-2] + 2 * wide[:, 1:-1] + wide[:, 2:]
    blurred = (wide[:, :, :-2] + 2 * wide[:, :, 1:-1] + wide[:, :, 2:]).reshape(-1, BINS)
    shares: NDArray[np.float64] = blurred / blurred.sum(axis=1, keepdims=True)
    return shares
