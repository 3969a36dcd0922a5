"""Shards of a dataset that is still made: finished, and not in its manifest yet."""

import contextlib
import dataclasses
from pathlib import Path

from storage.dataset.dataset import Dataset, LocalFiles
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import SHARD_NAME, number_of_shard
from storage.dataset.planned import num_planned
from storage.dataset.shard_notes import (
    ShardNote,
    fetch_notes,
    note_of,
    noted_names,
    noted_shard,
)
from storage.errors import TrilightError
from storage.remote.store import WRITABLE, BucketStore


def with_unlisted(dataset: Dataset) -> Dataset:
    """Return a dataset with the shards that are finished and not listed, as far as is known here.

    Raises:
        TrilightError: a note is none.
    """
    unlisted = _notes(dataset)
    if not unlisted:
        return dataset
    notes = {note.shard.name: note for note in unlisted}
    shards = {shard.name: shard for shard in dataset.manifest.shards}
    shards |= {name: note.shard for name, note in notes.items()}
    every = tuple(sorted(shards.values(), key=number_of_shard))
    failures = [failure for note in notes.values() for failure in note.failures]
    manifest = dataclasses.replace(dataset.manifest, shards=every)
    return Dataset(dataset.files, manifest, dataset.num_listed, failures)


def _notes(dataset: Dataset) -> list[ShardNote]:
    files = dataset.files
    manifest = dataset.manifest
    if isinstance(files, LocalFiles):
        folder = DatasetFolder(files.root)
        noted = filter(SHARD_NAME.fullmatch, noted_names(folder))
        return [noted_shard(folder, name) for name in noted if folder.shard(name).exists()]
    if files.url.scheme not in WRITABLE or len(manifest.shards) >= num_planned(manifest):
        return []
    with contextlib.suppress(TrilightError):  # it may be read and not listed
        names = BucketStore(files.url).list_all()
        bucket_root = DatasetFolder(Path())
        listed = {shard.name for shard in manifest.shards}
        unlisted = sorted(filter(SHARD_NAME.fullmatch, names - listed))
        notes = (note_of(bucket_root, name).as_posix() for name in unlisted)
        return fetch_notes(files.read, [name for name in notes if name in names], files.shown)
    return []
