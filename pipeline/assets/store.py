"""The asset store: what became of each source, made once and shared by every dataset and process.

An outcome's name says what it depends on: the bytes of the source, the settings and the recipe. It
is either an asset file or a refusal. Whoever makes one holds a lock that ends with the process, so
that others wait for the outcome instead of making it too. The folder may be deleted while nobody
uses it; then it is made again.
"""

import contextlib
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from pipeline.assets.recipe import READERS, RECIPE
from pipeline.assets.settings import AssetSettings
from storage.atomic import TEMPORARY_SUFFIX, write_atomically
from storage.claims import hold_claim
from storage.digests import canonical_json, sha256_hex
from storage.errors import Rejected
from storage.records.asset import Asset, encode_asset
from storage.typed_json import read_json

_FAN_OUT = 2
"""Letters of the name that choose a sub-folder, so that no folder holds every outcome."""

_OLD_S = 24 * 3600

_LOCKS = 3
"""Letters of the name that choose a lock: 4096 files that need no clearing away, at the price of a
rare wait for another object."""


@dataclass(frozen=True)
class _Refusal:
    """Content of the file of a refused source."""

    reason: str
    message: str


@dataclass(frozen=True)
class AssetStore:
    """The folder of outcomes."""

    root: Path
    """Shared by everybody who names it; file locks must work there."""

    def key(self, kind: str, source_sha256: str, settings: AssetSettings) -> str:
        """Return the name of the outcome of a source file of a kind and a digest."""
        parts = [kind, source_sha256, asdict(settings), RECIPE, READERS]
        return sha256_hex(canonical_json(parts))[:32]

    def asset_path(self, key: str) -> Path:
        """Return where the asset of a key is, or would be."""
        return self.root / key[:_FAN_OUT] / f"{key}.safetensors"

    def refusal(self, key: str) -> Rejected | None:
        """Return why the source was refused, where it was; TrilightError of a damaged file."""
        path = self._refusal_path(key)
        if not path.exists():
            return None
        refusal = read_json(path.read_bytes(), _Refusal, _named(path))
        return Rejected(refusal.reason, refusal.message)

    def unread(self, key: str) -> tuple[str, ...]:
        """Return what of the source no code has read; TrilightError of a damaged file."""
        path = self._unread_path(key)
        return tuple(read_json(path.read_bytes(), list[str], _named(path))) if path.exists() else ()

    def keep(self, key: str, asset: Asset, unread: tuple[str, ...] = ()) -> None:
        """Store an asset; raises TrilightError where that cannot be written."""
        path = self.asset_path(key)
        if unread:
            write_atomically(self._unread_path(key), canonical_json(unread))
        write_atomically(path, encode_asset(asset))
        _remove_old_leftovers(path.parent)

    def refuse(self, key: str, reason: str, message: str) -> None:
        """Store a refusal; raises TrilightError where that cannot be written."""
        outcome = canonical_json({"reason": reason, "message": message})
        write_atomically(self._refusal_path(key), outcome)

    @contextlib.contextmanager
    def making(self, key: str) -> Iterator[None]:
        """Wait until nobody else makes the outcome of this key, and keep others out meanwhile.

        Raises:
            TrilightError: the store cannot be written.
        """
        with hold_claim(self.root / "locks" / key[:_LOCKS], wait=True):
            yield

    def _unread_path(self, key: str) -> Path:
        return self.asset_path(key).with_suffix(".unread.json")

    def _refusal_path(self, key: str) -> Path:
        return self.asset_path(key).with_suffix(".json")


def _named(path: Path) -> str:
    return f"{path} of the asset store (delete it, and it is made again)"


def _remove_old_leftovers(folder: Path) -> None:
    """Delete what writers that were killed left behind: nobody writes one file for a day."""
    for leftover in folder.glob(f"*{TEMPORARY_SUFFIX}"):
        with contextlib.suppress(OSError):  # another process may have been quicker
            if time.time() - leftover.stat().st_mtime > _OLD_S:
                leftover.unlink()
