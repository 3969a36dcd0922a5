"""The asset store: a cache of prepared objects that every dataset and process shares.

An outcome's key depends on the bytes of the source, the settings and the recipe. The outcome is
either an asset file or a refusal. A process that computes one holds a lock that ends with the
process, so that others wait for the outcome instead of computing it too. The folder may be deleted
while no process uses it; its files are then computed again.
"""

from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeVar

from pipeline.assets.recipe import READERS, RECIPE
from pipeline.assets.settings import AssetSettings
from storage.atomic import remove_leftovers, write_atomically
from storage.digests import canonical_json, sha256_hex
from storage.errors import Rejected
from storage.file_locks import hold_lock
from storage.records.asset import Asset, encode_asset
from storage.typed_json import read_json

T = TypeVar("T")

_REFUSAL = ".json"
_UNREAD = ".unread.json"
_FAN_OUT = 2
"""Letters of the key that choose a sub-folder, so that no folder holds every outcome."""

_OLD_S = 24 * 3600
"""Age in seconds from which a temporary file counts as a leftover: no writer takes a day."""

_LOCKS = 3
"""Letters of the key that choose a lock: 4096 files that need no cleaning up, at the price of a
rare wait for another object."""


@dataclass(frozen=True)
class _Refusal:
    """Content of a refused source's file."""

    reason: str
    message: str


@dataclass(frozen=True)
class AssetStore:
    """A folder of outcomes, each under its key."""

    root: Path
    """Folder that several processes may share; its file system must support locks."""

    def key(self, kind: str, source_sha256: str, settings: AssetSettings) -> str:
        """Return the key of the outcome of a source file."""
        record = asdict(settings)
        if not settings.watertight:  # keys of earlier outcomes stay
            del record["watertight"]
        if settings.decimator == "pymeshlab":
            del record["decimator"]
        if settings.own_materials.transmission == "opaque":
            del record["own_materials"]["transmission"]
        parts = [kind, source_sha256, record, RECIPE, READERS]
        return sha256_hex(canonical_json(parts))[:32]

    def asset_path(self, key: str) -> Path:
        """Return the path of a key's asset, present or not."""
        return self.root / key[:_FAN_OUT] / f"{key}.safetensors"

    def refusal(self, key: str) -> Rejected | None:
        """Return the refusal of a source, if any; raises TrilightError for a damaged file."""
        refusal = self._read(key, _REFUSAL, _Refusal)
        return Rejected(refusal.reason, refusal.message) if refusal else None

    def unread(self, key: str) -> tuple[str, ...]:
        """Return notes on unread parts of the source; raises TrilightError for a damaged file."""
        return tuple(self._read(key, _UNREAD, list[str]) or ())

    def save_asset(self, key: str, asset: Asset, unread: tuple[str, ...] = ()) -> None:
        """Store an asset; raises TrilightError where the store cannot be written."""
        path = self.asset_path(key)
        if unread:
            write_atomically(path.with_suffix(_UNREAD), canonical_json(unread))
        write_atomically(path, encode_asset(asset))
        remove_leftovers(path.parent, older_than_s=_OLD_S)

    def save_refusal(self, key: str, reason: str, message: str) -> None:
        """Store a refusal; raises TrilightError where the store cannot be written."""
        outcome = canonical_json({"reason": reason, "message": message})
        write_atomically(self.asset_path(key).with_suffix(_REFUSAL), outcome)

    def lock(self, key: str) -> AbstractContextManager[bool]:
        """Hold the lock of a key; wait until no other process computes its outcome.

        Raises:
            TrilightError: the store cannot be written.
        """
        return hold_lock(self.root / "locks" / key[:_LOCKS], wait=True)

    def _read(self, key: str, suffix: str, kind: type[T]) -> T | None:
        path = self.asset_path(key).with_suffix(suffix)
        label = f"{path} of the asset store (delete it, and it is made again)"
        return read_json(path.read_bytes(), kind, label) if path.exists() else None
