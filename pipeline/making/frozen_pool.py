"""The frozen objects of a dataset as its makers have them: an index, and files where one is drawn.

A maker trusts what the lock has frozen and the asset store has proved: it starts without a look at
any object. A render child opens the one to three objects of its scene, checks their digests against
the lock, and keeps a few. An object whose file is not there any more, or was never on this machine,
is prepared again by the maker (`pipeline.making.restore_object`).
"""

from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

from pipeline.assets.store import AssetStore
from pipeline.scenes.budget import least_triangles
from pipeline.scenes.fitting import FitTable
from pipeline.scenes.pool import IndexedPool, PooledAsset
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.asset import decode_asset
from storage.records.lock_rows import LockRows
from storage.records.object_index import ObjectIndex

_MOST_OPEN = 8
"""Objects that a split of a child keeps; most scenes have three at most."""


@dataclass(frozen=True, kw_only=True)
class FrozenPool:
    """Where the frozen objects of a dataset are; it may travel to another machine."""

    lock: Path
    """objects.lock.jsonl of the dataset's folder."""
    index: Path
    """Its index (storage.records.object_index)."""
    source: str
    """Where the objects come from, for those that have to be prepared again."""
    licence: str | None
    """Of files without a statement, as the user states it."""

    def opened(self, split: str, store: AssetStore) -> "OpenedPool":
        """Return the objects of a split, sorted by uid; raises TrilightError without any."""
        return OpenedPool(self, split, store)


class AssetAway(Exception):
    """The prepared file of an object is not in the store, or is not the one of the lock.

    Attributes:
        uid: of the object.
        asset_name: of the file that is missing.
    """

    def __init__(self, uid: str, asset_name: str) -> None:
        super().__init__(f"object {uid!r}: its prepared file is not in the asset store")
        self.uid = uid
        self.asset_name = asset_name


class OpenedPool(IndexedPool):
    """The objects of one split, each opened when it is taken."""

    def __init__(self, frozen: FrozenPool, split: str, store: AssetStore) -> None:
        index = ObjectIndex(frozen.index)
        if split not in index.facts.splits:
            raise TrilightError(f"split {split!r}: no frozen object belongs to it; expected one.")
        rows = index.facts.splits[split]
        self.fits = FitTable(
            index.column("least", rows), index.column("camp", rows), index.facts.camps, rows.camps
        )
        self._offsets = index.column("offset", rows)
        self._index, self._first, self._split = index, rows.start, split
        self._lock, self._store = LockRows(frozen.lock), store
        self._open: OrderedDict[int, PooledAsset] = OrderedDict()

    def __len__(self) -> int:
        return len(self._offsets)

    def __getitem__(self, row: int) -> PooledAsset:  # type: ignore[override]
        """Return an object, from its file unless it was among the last.

        Raises:
            AssetAway: it has to be prepared again.
            TrilightError: the index is not that of the lock.
        """
        if not 0 <= row < len(self):
            raise IndexError(row)
        if row not in self._open:
            self._open[row] = self._read(row)
            if len(self._open) > _MOST_OPEN:
                self._open.popitem(last=False)
        self._open.move_to_end(row)
        return self._open[row]

    def _read(self, row: int) -> PooledAsset:
        locked = self._lock.at(int(self._offsets[row : row + 1][0]))
        name = self._index.asset_name(self._first + row)
        try:
            data = self._store.asset_path(name).read_bytes()
        except FileNotFoundError as error:
            raise AssetAway(locked.uid, name) from error
        if sha256_hex(data) != locked.asset_sha256:
            raise AssetAway(locked.uid, name)
        asset = decode_asset(data)
        pooled = PooledAsset(locked=locked, asset=asset)
        found = locked.split, least_triangles(asset), pooled.camp
        if found != (self._split, self.fits.size(row), self.fits.camp(row)):
            raise TrilightError(
                f"objects.index: says otherwise of {locked.uid!r} than objects.lock.jsonl and its "
                "file; expected the index of this lock. Delete .staging/objects.index, and it is "
                "made anew."
            )
        return pooled
