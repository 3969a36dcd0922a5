"""Stage "shards": packs the staged scenes of a shard into its tar file."""

import contextlib
import dataclasses
import os
import shutil
from typing import BinaryIO

from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import (
    Manifest,
    ShardEntry,
    index_shard,
    read_head,
    read_manifest,
    write_manifest,
)
from storage.dataset.progress import count_given_up
from storage.dataset.shard import samples_of, write_shard
from storage.dataset.shard_notes import (
    ShardNote,
    note_of,
    note_shard,
    noted_shard,
    rejections_of_shard,
)
from storage.dataset.staging import read_staged_scene, stage_members
from storage.errors import EnvironmentFailure, ShardMissing, TrilightError
from storage.records.objects import Failure, write_failures
from storage.records.packed_maps import MAP_NAME
from storage.records.sample import sample_key


def pack_shard(
    folder: DatasetFolder, name: str, scene_indices: range, *, grows: bool = False
) -> ShardEntry:
    """Write a shard from its staged scenes and return its manifest entry.

    The rejections are written before the shard, so that every reader of the shard finds them, and
    the staged scenes are deleted after it: a kill in between loses nothing and repeats little.

    An existing shard stays: the first writer wins. A growing one is replaced. Where a file system
    carries no locks, who comes second returns what the first has packed.

    Args:
        folder: the dataset.
        name: file name of the shard.
        scene_indices: indices of its scenes, all of which are staged.
        grows: True if the manifest lists the shard as growing; then call while holding its mutex.

    Raises:
        TrilightError: the disk is full, the folder cannot be written, or a staged file vanished.
    """
    try:
        return _pack(folder, name, scene_indices, grows=grows)
    except (
        FileNotFoundError,
        ShardMissing,
    ) as error:  # another process has packed it, and cleared away
        if folder.shard(name).exists() and name not in read_head(folder.manifest).growing:
            return index_shard(folder.shard(name))
        raise EnvironmentFailure(
            f"{name}: a file vanished while it was packed ({error}); expected one process at it, "
            "as locks ensure where a file system carries them. What was finished is safe: run "
            "the same command again."
        ) from error


def _pack(folder: DatasetFolder, name: str, scene_indices: range, *, grows: bool) -> ShardEntry:
    staged_folder = folder.staged_shard(name)
    failures: list[Failure] = []
    samples: list[tuple[str, dict[str, bytes]]] = []
    maps: dict[str, bytes] = {}
    for index in scene_indices:
        staged = read_staged_scene(staged_folder, index)
        failures.extend(staged.failures)
        if staged.members:
            for member in filter(MAP_NAME.fullmatch, staged.members):  # equal maps share memory
                staged.members[member] = maps.setdefault(member, staged.members[member])
            samples.append((sample_key(index), staged.members))
    path = folder.shard(name)
    rejections = rejections_of_shard(folder, name)
    write_failures(rejections, failures)
    if not grows:
        write_shard(path, samples)
        shutil.rmtree(staged_folder, ignore_errors=True)  # leftovers are never read
        return index_shard(path)
    written = folder.staging / path.name
    written.unlink(missing_ok=True)
    write_shard(written, samples)
    shard = index_shard(written)
    note_shard(folder, ShardNote(shard=shard, failures=tuple(failures)))  # until it has the name,
    os.replace(written, path)  # the old one can be read
    write_failures(rejections, failures)
    write_manifest(folder.manifest, read_manifest(folder.manifest).with_grown(shard))
    shutil.rmtree(staged_folder, ignore_errors=True)  # leftovers are never read
    return shard


def unpack_here(folder: DatasetFolder, name: str, scenes: range, manifest: Manifest) -> None:
    """Stage the scenes of a shard of the folder as `unpack_shard`, unless it is damaged."""
    with contextlib.suppress(TrilightError), folder.shard(name).open("rb") as stream:
        note = noted_shard(folder, name)
        known = {each.name: each for each in manifest.shards}
        if not note_of(folder, name).exists():  # the manifest's entry, or the file's
            note = dataclasses.replace(note, shard=known.get(name, note.shard))
        if index_shard(folder.shard(name)) == note.shard:
            unpack_shard(folder, note, scenes, stream)


def unpack_shard(folder: DatasetFolder, note: ShardNote, scenes: range, stream: BinaryIO) -> None:
    """Stage the scenes of a shard again, byte for byte, so that it can be packed with more.

    Args:
        folder: the dataset.
        note: note on the shard.
        scenes: indices of its scenes; one that the file lacks was given up.
        stream: bytes of the shard.
    """
    name = note.shard.name
    samples = dict(samples_of(stream, name))
    for index in scenes:
        key = sample_key(index)
        failures = [failure for failure in note.failures if failure.item == key]
        if key not in samples:
            count_given_up(folder, index)
        stage_members(folder.staged_shard(name), index, samples.get(key, {}), failures)
