"""What scenes are made of: the accepted objects of one split, with their meshes."""

from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.scenes.budget import least_triangles
from pipeline.scenes.fitting import FitTable
from storage.licences import share_alike_camp
from storage.records.asset import Asset
from storage.records.objects import LockedObject


@dataclass(frozen=True, kw_only=True, eq=False)
class PooledAsset:
    """An object as the lock file names it, and its meshes."""

    locked: LockedObject
    """Identity, split and rights."""
    asset: Asset
    """Meshes at falling budgets."""

    @property
    def camp(self) -> str:
        """Objects of two camps never meet in a scene: their licences could not both be kept."""
        return share_alike_camp(self.locked.licence)


class IndexedPool(Sequence[PooledAsset]):
    """Objects of which each is opened when it is taken, and that are drawn without opening any."""

    fits: FitTable
    """What a draw asks of them."""


def fits_of(pool: Sequence[PooledAsset]) -> FitTable:
    """Return what a draw asks of the objects of a pool."""
    if isinstance(pool, IndexedPool):
        return pool.fits
    return FitTable.of([least_triangles(entry.asset) for entry in pool], [e.camp for e in pool])
