"""Prepares a frozen object again if its prepared file is missing; the result must be the same."""

import functools
from pathlib import Path

from pipeline.generation.freeze_objects import object_changed_error, require_tried
from pipeline.generation.frozen_pool import ComposedScenes
from pipeline.generation.generation_run import ShardJob
from pipeline.generation.prepare_isolated import asset_store, prepare_isolated
from pipeline.objects.sources import ListedObjects, list_objects
from storage.atomic import write_atomically
from storage.digests import sha256_hex
from storage.records.objects import LockRows, ObjectRecord
from storage.remote.safe_url import safe_url


def restore_object(job: ShardJob, uid: str, asset_name: str) -> None:
    """Make the prepared file of an object again; its digest must be the one in the lock.

    Args:
        job: job of the dataset.
        uid: uid of the object.
        asset_name: name of its file in the dataset's index.

    Raises:
        TrilightError: the source has lost or changed the object.
        EnvironmentFailure: it could not be prepared this time.
    """
    origin = job.accepted.origin
    assert isinstance(origin, ComposedScenes), "only composed scenes draw objects"
    frozen = origin.pool
    store = asset_store()
    display_name = safe_url(frozen.source)
    locked = LockRows(frozen.lock).find(uid)
    path = store.asset_path(asset_name)
    settings = job.settings
    if locked is not None and _holds(path, locked.asset_sha256):
        return  # another worker was faster
    path.unlink(missing_ok=True)
    work_dir = job.folder.staged_objects
    allowed = tuple(settings.allowed_licences)
    record = find_object(frozen.source, frozen.licence, work_dir, allowed, uid)
    if record is None or locked is None:
        raise object_changed_error(display_name, uid, "is missing or no longer usable")
    prepared, rejected = prepare_isolated(
        [record], settings.mesh_settings, workers=1, done=lambda: None
    )
    if rejected:
        require_tried(display_name, rejected[0])
    if not prepared or prepared[0].asset_sha256 != locked.asset_sha256:
        raise object_changed_error(
            display_name, uid, "has changed" if prepared else "is no longer usable"
        )
    if prepared[0].asset_name != asset_name:  # a later recipe gives it another name
        write_atomically(path, store.asset_path(prepared[0].asset_name).read_bytes())


def _holds(path: Path, sha256: str) -> bool:
    try:
        return sha256_hex(path.read_bytes()) == sha256
    except FileNotFoundError:
        return False


def find_object(
    source: str, licence: str | None, work_dir: Path, allowed: tuple[str, ...], uid: str
) -> ObjectRecord | None:
    """Return an object of a source, with its file on this machine; None if the source lacks it."""
    for _ in range(2):  # the cached list may be older than the file
        listed = _list_source(source, licence, work_dir, allowed)
        for record in listed.fetch_selected(lambda other: other == uid).records:
            if Path(record.path).exists():
                return record
        _list_source.cache_clear()
    return None


@functools.lru_cache(maxsize=1)
def _list_source(
    source: str, licence: str | None, work_dir: Path, allowed: tuple[str, ...]
) -> ListedObjects:
    """Return the objects of a source; cached, so that many missing objects cost one listing."""
    return list_objects(source, work_dir=work_dir, allowed_licences=allowed, licence=licence)
