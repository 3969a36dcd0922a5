"""Stage "assets": every object becomes a prepared asset or a rejection, each made only once.

An outcome is stored under a name made of what it depends on: the bytes of the source, the settings
and the recipe. A run that was killed finds the finished ones again, and copies of a file share one.
"""

import contextlib
import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path

from pipeline.assets.recipe import METHODS, RECIPE
from pipeline.assets.settings import AssetSettings
from pipeline.assets.source_file import read_source
from pipeline.isolation import ChildFailed, IsolatedChild
from storage.asset import Asset, decode_asset, encode_asset
from storage.atomic import write_atomically
from storage.digests import canonical_json, sha256_hex
from storage.errors import Rejected
from storage.layout import DatasetFolder
from storage.records import Failure, ObjectRecord

_MAY_PASS = ("killed", "out_of_memory")
"""What may go better on the next run, so that it is not remembered as a property of the object."""


@dataclass(frozen=True, kw_only=True)
class PreparedAsset:
    """An accepted object."""

    record: ObjectRecord
    """Identity and rights."""
    file_name: str
    """Its asset file in the staging folder."""
    asset_sha256: str
    """Digest of that file."""
    geometry_sha256: str
    """Digest of its cleaned geometry."""


def prepare_assets(
    records: list[ObjectRecord],
    settings: AssetSettings,
    folder: DatasetFolder,
    *,
    borrow_child: Callable[[], AbstractContextManager[IsolatedChild]],
    workers: int,
) -> tuple[list[PreparedAsset], list[Failure]]:
    """Prepare every object in isolated children; returns both lists in the order of `records`.

    Raises:
        TrilightError: the output cannot be written.
    """

    def prepare(record: ObjectRecord) -> PreparedAsset | Failure:
        return _prepare_once(record, settings, folder, borrow_child)

    with ThreadPoolExecutor(workers) as threads:
        outcomes = list(threads.map(prepare, records))
    prepared = [outcome for outcome in outcomes if isinstance(outcome, PreparedAsset)]
    return prepared, [outcome for outcome in outcomes if isinstance(outcome, Failure)]


def _prepare_once(
    record: ObjectRecord,
    settings: AssetSettings,
    folder: DatasetFolder,
    borrow_child: Callable[[], AbstractContextManager[IsolatedChild]],
) -> PreparedAsset | Failure:
    try:
        key = _outcome_key(Path(record.path), settings)
    except Rejected as rejection:
        return _failure(record, rejection.reason, rejection.message)
    except OSError as error:
        return _failure(record, "unreadable_file", f"cannot be read ({error.strerror})")
    path = folder.staged_assets / f"{key}.safetensors"
    refusal = folder.staged_assets / f"{key}.json"
    if refusal.exists():
        return _failure(record, **json.loads(refusal.read_bytes()))
    if not path.exists():
        try:
            with borrow_child() as child:
                asset = _prepare_by_any_method(child, record, settings)
        except (Rejected, ChildFailed) as error:
            outcome = {"reason": error.reason, "message": error.message}
            if error.reason not in _MAY_PASS:
                write_atomically(refusal, canonical_json(outcome))
            return _failure(record, **outcome)
        write_atomically(path, encode_asset(asset))
    return _prepared(record, path)


def _prepare_by_any_method(
    child: IsolatedChild, record: ObjectRecord, settings: AssetSettings
) -> Asset:
    """Try the methods in turn, each in a fresh child after one that killed its own."""
    for method in METHODS[:-1]:
        with contextlib.suppress(ChildFailed):
            return child.call(prepare_in_child, record, settings, method)
    return child.call(prepare_in_child, record, settings, METHODS[-1])


def prepare_in_child(record: ObjectRecord, settings: AssetSettings, method: str) -> Asset:
    """Run the recipe; only here are the mesh libraries imported, and only children come here."""
    from pipeline.assets.prepare import prepare_asset

    return prepare_asset(record, settings, method)


def _prepared(record: ObjectRecord, path: Path) -> PreparedAsset:
    data = path.read_bytes()
    return PreparedAsset(
        record=record,
        file_name=path.name,
        asset_sha256=sha256_hex(data),
        geometry_sha256=decode_asset(data).geometry_sha256,
    )


def _outcome_key(path: Path, settings: AssetSettings) -> str:
    """Name an outcome by what it depends on; raises Rejected where the pre-flight refuses."""
    source = read_source(path, settings)
    return sha256_hex(canonical_json([source.kind, source.sha256, asdict(settings), RECIPE]))[:32]


def _failure(record: ObjectRecord, reason: str, message: str) -> Failure:
    return Failure(stage="assets", item=record.uid, reason=reason, message=message)
