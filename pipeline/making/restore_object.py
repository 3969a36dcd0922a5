"""A frozen object whose prepared file is not here: it is prepared again, and must be the same."""

import functools
from pathlib import Path

from pipeline.making.freeze_objects import changed, require_tried
from pipeline.making.prepare_isolated import asset_store, prepare_isolated
from pipeline.making.run import ShardJob
from pipeline.objects.sources import ListedObjects, list_objects
from storage.atomic import write_atomically
from storage.digests import sha256_hex
from storage.records.lock_rows import LockRows
from storage.records.objects import ObjectRecord
from storage.remote.safe_url import safe_url


def restore_object(job: ShardJob, uid: str, asset_name: str) -> None:
    """Bring the prepared file of an object back, of the bytes that the lock names.

    Args:
        job: of the dataset.
        uid: of the object.
        asset_name: by which the index of the dataset knows its file.

    Raises:
        TrilightError: the source has no such object any more, or another one.
        EnvironmentFailure: it could not be prepared this time.
    """
    frozen, store = job.accepted.pool, asset_store()
    assert frozen is not None
    shown, locked = safe_url(frozen.source), LockRows(frozen.lock).find(uid)
    place, settings = store.asset_path(asset_name), job.settings
    if locked is not None and _holds(place, locked.asset_sha256):
        return  # somebody was quicker
    place.unlink(missing_ok=True)
    work_dir, allowed = job.folder.staged_objects, tuple(settings.allowed_licences)
    record = found_again(frozen.source, frozen.licence, work_dir, allowed, uid)
    if record is None or locked is None:
        raise changed(shown, uid, "is missing or no longer usable")
    prepared, rejected = prepare_isolated(
        [record], settings.mesh_settings, workers=1, done=lambda: None
    )
    if rejected:
        require_tried(shown, rejected[0])
    if not prepared or prepared[0].asset_sha256 != locked.asset_sha256:
        raise changed(shown, uid, "has changed" if prepared else "is no longer usable")
    if prepared[0].path != place:  # a later recipe knows it by another name
        write_atomically(place, prepared[0].path.read_bytes())


def _holds(path: Path, sha256: str) -> bool:
    try:
        return sha256_hex(path.read_bytes()) == sha256
    except FileNotFoundError:
        return False


def found_again(
    source: str, licence: str | None, work_dir: Path, allowed: tuple[str, ...], uid: str
) -> ObjectRecord | None:
    """Return an object of a source, with its file here; None where it is not, or no longer."""
    for _ in range(2):  # a list that was made before may be older than the file
        listed = _listed(source, licence, work_dir, allowed)
        for record in listed.found(lambda other: other == uid).records:
            if Path(record.path).exists():
                return record
        _listed.cache_clear()
    return None


@functools.lru_cache(maxsize=1)
def _listed(
    source: str, licence: str | None, work_dir: Path, allowed: tuple[str, ...]
) -> ListedObjects:
    """Return what a source holds; it is listed once, however many objects are away."""
    return list_objects(source, work_dir=work_dir, allowed_licences=allowed, licence=licence)
