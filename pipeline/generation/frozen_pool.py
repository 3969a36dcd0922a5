"""`ComposedScenes`: the frozen objects of a dataset, opened when a scene draws them.

A worker trusts the lock and the asset store: it starts without opening any object. A render child
opens the one to three objects of its scene, checks their digests against the lock, and keeps a few
open. If an object's file is missing on this machine, the worker prepares it again
(`pipeline.generation.render_workers.restore_object`).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.asset_store import AssetStore
from pipeline.objects.maps.prepared import decode_prepared
from pipeline.scenes.triangle_budget import FitTable, PooledAsset, least_triangles
from scene_templates.textures import OwnMaps, UserMap, UserTexture
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.asset import decode_asset
from storage.records.object_index import ObjectIndex
from storage.records.objects import SKY, TEXTURE, LockedObject, LockRows
from storage.records.texture import MapSource

_MOST_OPEN = 8
"""Objects that a child keeps open for each split; most scenes have three at most."""


@dataclass(frozen=True, kw_only=True)
class ComposedScenes:
    """Scenes that layouts compose of frozen objects; can be sent to another machine."""

    lock: Path
    """Path of objects.lock.jsonl in the dataset's folder."""
    index: Path
    """Path of the lock's index (storage.records.object_index)."""
    source: str
    """Source of the objects, for those that have to be prepared again."""
    licence: str | None
    """Licence that the user states for files without one."""
    maps: tuple[tuple[LockedObject, Path], ...] = ()
    """The user's textures and skies with their prepared files."""


class AssetMissing(Exception):
    """The store lacks the prepared file of an object, or has another than the lock's.

    Attributes:
        uid: uid of the object.
        asset_name: name of the missing file.
    """

    def __init__(self, uid: str, asset_name: str) -> None:
        super().__init__(f"object {uid!r}: its prepared file is not in the asset store")
        self.uid = uid
        self.asset_name = asset_name


class SplitPool(Sequence[PooledAsset]):
    """The objects of one split, sorted by uid, each opened on access."""

    def __init__(self, frozen: ComposedScenes, split: str, store: AssetStore) -> None:
        index = ObjectIndex(frozen.index)
        if split not in index.facts.splits:
            raise TrilightError(f"split {split!r}: no frozen object belongs to it; expected one.")
        rows = index.facts.splits[split]
        self.fits = FitTable(
            index.column("least", rows), index.column("camp", rows), index.facts.camps, rows.camps
        )
        self._offsets = index.column("offset", rows)
        self._index = index
        self._first = rows.start
        self._split = split
        self._lock = LockRows(frozen.lock)
        self._store = store
        self._open = lru_cache(_MOST_OPEN)(self._read)

    def __len__(self) -> int:
        return len(self._offsets)

    def __getitem__(self, row: int) -> PooledAsset:  # type: ignore[override]
        """Return an object; read its file unless it is still open.

        Raises:
            AssetMissing: it has to be prepared again.
            TrilightError: the index is not that of the lock.
        """
        if not 0 <= row < len(self):
            raise IndexError(row)
        return self._open(row)

    def _read(self, row: int) -> PooledAsset:
        locked = self._lock.at(int(self._offsets[row : row + 1][0]))
        name = self._index.asset_name(self._first + row)
        try:
            data = self._store.asset_path(name).read_bytes()
        except FileNotFoundError as error:
            raise AssetMissing(locked.uid, name) from error
        if sha256_hex(data) != locked.asset_sha256:
            raise AssetMissing(locked.uid, name)
        asset = decode_asset(data)
        pooled = PooledAsset(locked=locked, asset=asset)
        stored = locked.split, least_triangles(asset), pooled.camp
        if stored != (self._split, self.fits.size(row), self.fits.camp(row)):
            raise TrilightError(
                f"objects.index: says otherwise of {locked.uid!r} than objects.lock.jsonl and its "
                "file; expected the index of this lock. Delete .staging/objects.index, and it is "
                "made again."
            )
        return pooled


def user_maps(rows: Iterable[tuple[LockedObject, Path]], split: str) -> OwnMaps:
    """Return the maps that scenes of a split may use, sorted by uid; no file is read yet.

    Args:
        rows: rows of a lock with the prepared files; objects among them are left out.
        split: train, validation or test.
    """
    of_split = sorted(
        ((locked, path) for locked, path in rows if locked.split == split),
        key=lambda pair: pair[0].uid,
    )

    def maps_of(kind: str, load: Callable[[Path], Any]) -> list[UserMap[Any]]:
        return [
            UserMap(
                uid=locked.uid,
                source=MapSource(
                    name=locked.title,
                    licence=locked.licence,
                    attribution=locked.attribution,
                    source_url=locked.source_url,
                ),
                load=partial(load, path),
            )
            for locked, path in of_split
            if locked.kind == kind
        ]

    return OwnMaps(textures=maps_of(TEXTURE, _texture), skies=maps_of(SKY, _radiance))


def _texture(path: Path) -> UserTexture:
    arrays = decode_prepared(path.read_bytes(), path.name).arrays
    return arrays["diffuse"], arrays["specular"], arrays.get("roughness")


def _radiance(path: Path) -> NDArray[np.float32]:
    return decode_prepared(path.read_bytes(), path.name).arrays["radiance"]


def changed_error(display_name: str, uid: str, state: str) -> TrilightError:
    """Return the error of a frozen object or file that its source has lost or changed."""
    return TrilightError(
        f"{display_name}: {uid!r} {state}; expected what the dataset was begun with "
        "(objects.lock.jsonl). Restore it, name the source that has it by --objects or "
        "--scenes-from, or choose another --out."
    )


def require_same(
    display_name: str, frozen: Mapping[str, LockedObject], now: Sequence[LockedObject]
) -> None:
    """Raise TrilightError if a row differs from the frozen one, is missing, or is new."""
    by_uid = {entry.uid: entry for entry in now}
    for uid in sorted({*frozen, *by_uid}):
        if frozen.get(uid) != by_uid.get(uid):
            state = "has changed" if uid in by_uid else "is missing or no longer usable"
            raise changed_error(display_name, uid, state if uid in frozen else "is new")
