"""The pool that scenes draw from: the accepted objects of one split, with their meshes."""

from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.scenes.triangle_budget import FitTable, least_triangles
from storage.licences import share_alike_camp
from storage.records.asset import Asset
from storage.records.objects import LockedObject


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


class IndexedPool(Sequence[PooledAsset]):
    """A pool that opens an object on access, and draws without opening any."""

    fits: FitTable
    """Triangles and licence camp of every object, for the draw."""


def fits_of(pool: Sequence[PooledAsset]) -> FitTable:
    """Return the table from which objects of a pool are drawn."""
    if isinstance(pool, IndexedPool):
        return pool.fits
    return FitTable.of([least_triangles(entry.asset) for entry in pool], [e.camp for e in pool])
