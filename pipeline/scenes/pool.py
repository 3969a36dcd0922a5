"""What scenes are made of: the accepted objects of one split, with their meshes."""

from dataclasses import dataclass

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
