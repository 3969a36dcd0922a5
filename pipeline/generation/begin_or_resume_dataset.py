"""Begins a dataset in a folder or a bucket, or resumes the one there with the same settings.

`DatasetWriter.unfinished_shards` says which shards are left: finished ones are skipped.
"""

import contextlib
import dataclasses
import shutil
from collections.abc import Mapping
from functools import partial
from typing import Any

from pipeline.generation.dataset_writer import (
    PLANNED,
    DatasetWriter,
    fetch_lock,
    merge_failures,
    published_head,
)
from pipeline.presets.settings import DatasetSettings, differences
from pipeline.renders.mitsuba_variant import device_of
from storage.dataset.derived import derivation_of
from storage.dataset.layout import DatasetFolder, place_of_part
from storage.dataset.manifest import Manifest, read_head, write_manifest
from storage.dataset.splits import planned_scenes
from storage.errors import TrilightError
from storage.extensions import extension_digests, require_same_extensions
from storage.remote.store import Store
from storage.settings.described import from_record


def hold_dataset_lock(folder: DatasetFolder) -> contextlib.AbstractContextManager[None]:
    """Hold the lock that a dataset's workers share; one that is alone updates the folder.

    Before a bucket it gets the bucket's state. Elsewhere, the manifest of a dataset without any
    object, scene or shard is deleted: it begins again.

    Raises:
        TrilightError: the folder cannot be written, or the bucket not be read.
    """
    store = folder.store()
    return folder.hold_shared_lock(
        partial(_forget_unused, folder) if store.is_here else partial(_adopt, folder, store)
    )


def require_its_extensions(folder: DatasetFolder) -> None:
    """Refuse other extensions than a dataset has, before settings name what those add.

    A dataset without frozen objects may begin again, and what a bucket holds is known only later.

    Raises:
        TrilightError: they differ, or the manifest cannot be read.
    """
    if not folder.bucket and folder.manifest.exists():
        manifest = read_head(folder.manifest)
        if manifest.objects_lock_sha256:
            _require_extendable(folder, manifest)


def _require_extendable(folder: DatasetFolder, manifest: Manifest) -> None:
    if derivation := derivation_of(manifest.settings):
        raise TrilightError(
            f"{folder.display_name}: this dataset was made by `trilight shards "
            f"{derivation.operation}` "
            "and cannot grow; extend its sources and make it again, or choose another --out."
        )
    require_same_extensions(folder.display_name, manifest.extensions, extension_digests("data"))


def _forget_unused(folder: DatasetFolder) -> None:
    """Delete the manifest of a dataset without any frozen object, scene or shard.

    A run that ended that early, over its objects, must not bind the next one to its settings. Call
    while alone in the folder; a worker that missed this notices it (`DatasetWriter.refresh`).
    """
    with contextlib.suppress(TrilightError):  # a later reader reports an unreadable manifest
        if read_head(folder.manifest).objects_lock_sha256:
            return
        folder.objects_lock.unlink(missing_ok=True)  # a kill came before the manifest named it
        if not folder.shard_files() and not any(folder.staged_samples.rglob("*.tar")):
            folder.manifest.unlink()


def _adopt(folder: DatasetFolder, store: Store) -> None:
    """Give the folder before a bucket the bucket's state; call while no other process uses it.

    Staged scenes stay only if the bucket holds the same dataset.
    """
    theirs = published_head(folder, store)
    own_head = None
    with contextlib.suppress(TrilightError):
        own_head = read_head(folder.manifest)
    if not (theirs and own_head and own_head.identity == theirs.identity):
        own_head = None
        folder.clear()
    shutil.rmtree(folder.staged_sent, ignore_errors=True)  # it is looked at again
    if theirs is None:
        return
    _publish_plan(store, theirs.num_scenes)
    if own_head:  # as the shards here were packed
        theirs = dataclasses.replace(
            theirs, num_scenes=own_head.num_scenes, growing=own_head.growing
        )
    fetch_lock(folder, store, theirs.objects_lock_sha256)
    if not theirs.objects_lock_sha256:
        merge_failures(folder, store)
    write_manifest(folder.manifest, theirs)


def _publish_plan(store: Store, num_scenes: int) -> None:
    """Publish a requested number of scenes; in a folder the manifest does so."""
    if not store.is_here:
        store.put(f"{PLANNED}{num_scenes:012d}", b"\n")


def begin_or_resume_dataset(
    folder: DatasetFolder,
    settings: DatasetSettings,
    environment: Mapping[str, Any],
    num_scenes: int,
    *,
    accept_environment: bool,
) -> DatasetWriter:
    """Begin a dataset in a folder or a bucket, or resume the one that is there.

    The number of scenes never falls. Call while holding the dataset's lock.

    Raises:
        TrilightError: the dataset was begun with other settings, or in another environment and
            `accept_environment` is False, and the message names what differs; the bucket cannot be
            listed, read or written, or its server would let two workers create the same file.
    """
    if num_scenes < 1:
        raise TrilightError(f"scenes is {num_scenes}; expected at least 1.")
    num_planned = planned_scenes(num_scenes, settings.splits)
    store = folder.store()
    with folder.mutex("manifest"):
        if is_new := store.get(folder.manifest.name, 1) is None:
            _require_free(folder, store)
            store.require_create()
        if not folder.manifest.exists():
            manifest = Manifest(
                build=settings.build,
                settings=settings.as_json(),
                environment=environment,
                num_scenes=num_planned,
                num_views=settings.scenes.num_views,
                objects_lock_sha256="",
                shards=(),
                extensions=extension_digests("data"),
            )
            write_manifest(folder.manifest, manifest)
        if is_new and not store.create_if_absent(folder.manifest.name, folder.manifest):
            _adopt(folder, store)  # another machine was first
        manifest = read_head(folder.manifest)
        _require_same_dataset(folder, manifest, settings, environment, accept_environment)
        writer = DatasetWriter(store, folder, manifest, settings.splits)
        if num_planned > manifest.num_scenes:
            writer.extend(num_planned)
    _publish_plan(store, writer.manifest.num_scenes)
    writer.refresh_plan()
    return writer


def _require_same_dataset(
    folder: DatasetFolder,
    manifest: Manifest,
    settings: DatasetSettings,
    environment: Mapping[str, Any],
    accept_environment: bool,
) -> None:
    _require_extendable(folder, manifest)
    stored = from_record(DatasetSettings, manifest.settings).as_json()  # fields may come later
    _require_same(folder, "setting", stored, settings.as_json(), "choose another --out")
    if not accept_environment:
        before = device_of(manifest.environment)
        now = device_of(environment)
        if before != now:
            raise TrilightError(
                f"{folder.display_name}: this dataset was begun on a {before.upper()} and would "
                f"go on with a {now.upper()}; choose --device {before} or another --out, or accept "
                "pictures that agree only within their stated errors with --accept-environment."
            )
        _require_same(
            folder,
            "environment",
            manifest.environment,
            environment,
            "choose another --out, or accept pictures that agree only within their noise "
            "floors with --accept-environment",
        )


def _require_free(folder: DatasetFolder, store: Store) -> None:
    """Raise if there are shards, or a document that the dataset's own would replace."""
    existing = store.list() | store.list(place_of_part(1))
    if any(name.endswith(".tar") for name in existing):
        raise TrilightError(
            f"{folder.display_name}: there are shards but no manifest.json; expected an empty "
            "folder or a "
            "dataset. Choose another --out."
        )
    for path in (folder.card, folder.licences):
        if path.name in existing:
            raise TrilightError(
                f"{folder.display_name}: {path.name} is there, and the dataset's own would replace "
                "it; "
                "expected an empty folder or a dataset. Choose another --out."
            )


def _require_same(
    folder: DatasetFolder,
    what: str,
    before: Mapping[str, Any],
    now: Mapping[str, Any],
    next_step: str,
) -> None:
    differing = list(differences(before, now))
    if differing:
        name, old, new = differing[0]
        more = f" (and {len(differing) - 1} more)" if len(differing) > 1 else ""
        raise TrilightError(
            f"{folder.display_name}: this dataset was begun with another {what}: {name} was "
            f"{old!r}, now "
            f"{new!r}{more}; {next_step}."
        )
