"""The triangle budget: draws objects that still fit, and chooses a level of detail (LOD) for each.

A limit per object would either waste most of a scene's triangles or overflow it (the published
recipes do both). Here objects are drawn among those that still fit; each begins with its coarsest
level. The object with the largest distance to its source gets the next finer level, until all are
near enough or no finer level fits.

A split may have millions of objects. A draw needs the triangles of each and the camp of its
licence: two columns that are read in chunks, and not at all if every object fits, as usual.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.errors import Rejected
from storage.licences import share_alike_camp
from storage.records.asset import Asset, Level
from storage.records.object_index import CampSizes
from storage.records.objects import LockedObject

_CHUNK = 1 << 16
"""Rows of a column that are read together: half a megabyte."""


@dataclass(frozen=True, eq=False)
class FitTable:
    """Triangles and camp of every object of a split, in the order of their uids.

    The columns are arrays in memory, or in a file, that are read by slices.
    """

    least: Any
    """Triangles of the coarsest level of each row."""
    camp_numbers: Any
    """Number of each row's camp."""
    camps: Sequence[str]
    """Name of each camp by number; "" is for objects without a camp."""
    sizes: Mapping[str, CampSizes]
    """Number and sizes of the objects of each camp that occurs."""

    def size(self, row: int) -> int:
        return int(self.least[row : row + 1][0])

    def camp(self, row: int) -> str:
        return self.camps[int(self.camp_numbers[row : row + 1][0])]

    def draw_row(self, rng: np.random.Generator, rooms: Mapping[str, int]) -> int | None:
        """Draw a row uniformly among those that fit; None if none does.

        Args:
            rooms: most triangles by camp; rows of other camps do not fit.
        """
        if rooms.keys() == self.sizes.keys() and all(
            self.sizes[camp].most <= room for camp, room in rooms.items()
        ):
            return int(rng.integers(len(self.least)))
        limits = np.array([rooms.get(camp, -1) for camp in self.camps], np.int64)
        starts = range(0, len(self.least), _CHUNK)
        counts = np.cumsum([np.count_nonzero(self._fits(start, limits)) for start in starts])
        if not counts[-1]:
            return None
        number = int(rng.integers(counts[-1]))
        chunk = int(np.searchsorted(counts, number, side="right"))
        before = int(counts[chunk - 1]) if chunk else 0
        fitting = np.flatnonzero(self._fits(starts[chunk], limits))
        return starts[chunk] + int(fitting[number - before])

    def _fits(self, start: int, limits: NDArray[np.int64]) -> NDArray[np.bool_]:
        chunk = slice(start, start + _CHUNK)
        fits: NDArray[np.bool_] = self.least[chunk] <= limits[self.camp_numbers[chunk]]
        return fits


@dataclass(frozen=True, kw_only=True, eq=False)
class PooledAsset:
    """An object as the lock file names it, and its meshes."""

    locked: LockedObject
    """The object's row of the lock: uid, split and rights."""
    asset: Asset
    """Meshes of the object at several levels of detail."""

    @property
    def camp(self) -> str:
        """Objects of two camps never meet in a scene: their licences could not both be kept."""
        return share_alike_camp(self.locked.licence)


class ObjectPool(Sequence[PooledAsset]):
    """Objects from which scenes are composed, sorted by uid."""

    fits: FitTable
    """Table from which objects are drawn, so that only those drawn are opened."""


def draw_rows(
    rng: np.random.Generator, table: FitTable, count: int, num_triangles: int
) -> list[int]:
    """Draw rows with replacement, uniformly among those that fit beside the earlier ones.

    If all fit, this is a uniform draw. Otherwise simple objects are drawn more often beside
    demanding ones, as they would be if whole scenes were drawn until one fits. Objects of two
    different camps never fit beside each other.

    Args:
        table: table to draw from, with at least one row.
        num_triangles: most triangles of all rows together.

    Raises:
        Rejected: "over_budget" if not even the simplest objects fit.
    """
    allowed = set(table.sizes)
    remaining = num_triangles
    rows = list[int]()
    for following in range(count - 1, -1, -1):
        rooms = dict[str, int]()
        for camp in allowed:  # after this row and the others there must be room for the simplest
            camps = allowed & {"", camp} if camp else allowed
            rooms[camp] = remaining - following * min(table.sizes[each].least for each in camps)
        row = table.draw_row(rng, rooms)
        if row is None:
            least = min(sizes.least for sizes in table.sizes.values())
            raise Rejected(
                "over_budget",
                f"{count} objects of at least {least} triangles each do not fit into the "
                f"{num_triangles} that the scene has for them",
            )
        rows.append(row)
        remaining -= table.size(row)
        if camp := table.camp(row):
            allowed &= {"", camp}
    return rows


def levels_within(
    assets: Sequence[Asset], num_triangles: int, enough_error: float
) -> tuple[Level, ...]:
    """Choose one level per asset, together at most `num_triangles`.

    Args:
        assets: assets whose coarsest levels fit together (`draw_rows`).
        num_triangles: most triangles of all assets together.
        enough_error: two-way distance to the source (99th percentile, fraction of the diagonal)
            below which an asset is not refined.

    Raises:
        Rejected: "over_budget" if the coarsest levels do not fit.
    """
    ladders = [sorted(asset.levels, key=_size) for asset in assets]
    rungs = [0] * len(assets)
    remaining = num_triangles - sum(_size(ladder[0]) for ladder in ladders)
    if remaining < 0:
        raise Rejected(
            "over_budget",
            f"{len(assets)} objects need {num_triangles - remaining} triangles at least, and the "
            f"scene has {num_triangles} for them",
        )
    while True:
        finer = [
            (ladder[rung].record.quality.error_p99, -row)
            for row, (ladder, rung) in enumerate(zip(ladders, rungs, strict=True))
            if rung + 1 < len(ladder)
            and ladder[rung].record.quality.error_p99 > enough_error
            and _size(ladder[rung + 1]) - _size(ladder[rung]) <= remaining
        ]
        if not finer:
            return tuple(ladder[rung] for ladder, rung in zip(ladders, rungs, strict=True))
        row = -max(finer)[1]  # the first of equals
        remaining -= _size(ladders[row][rungs[row] + 1]) - _size(ladders[row][rungs[row]])
        rungs[row] += 1


def least_triangles(asset: Asset) -> int:
    return min(_size(level) for level in asset.levels)


def _size(level: Level) -> int:
    return len(level.faces)
