"""Stage "shards": the staged scenes of a shard become its tar file."""

import dataclasses
import itertools
import logging
import shutil
from collections.abc import Iterable
from pathlib import Path

from storage.atomic import atomic_writer, write_atomically
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import (
    ShardEntry,
    index_shard,
    index_stream,
    read_manifest,
    write_manifest,
)
from storage.dataset.shard import iterate_samples, write_shard, write_tar
from storage.dataset.shard_notes import (
    ShardNote,
    encode_note,
    note_of,
    noted_shard,
    rejections_of_shard,
)
from storage.dataset.staging import read_staged_scene
from storage.errors import TrilightError
from storage.records.map_references import MAP_NAME
from storage.records.objects import Failure, write_failures
from storage.records.sample import sample_key

log = logging.getLogger("trilight.scenes")

Samples = list[tuple[str, dict[str, bytes]]]
"""Samples of a shard: key, and members by suffix."""


def pack_shard(folder: DatasetFolder, name: str, scene_indices: range) -> ShardEntry:
    """Write a shard from its staged scenes and return its manifest entry.

    The rejections are written before the shard, so that every reader of the shard finds them, and
    the staged scenes are deleted after it: a kill in between loses nothing and repeats little.

    Where the shard is there already, it stays: the first writer wins.

    Args:
        folder: the dataset.
        name: file name of the shard.
        scene_indices: its scenes, all of which are staged.

    Raises:
        TrilightError: the disk is full or the folder cannot be written.
    """
    staged_folder, path = folder.staged_shard(name), folder.shard(name)
    try:
        samples, failures = _read_staged(staged_folder, scene_indices)
    except FileNotFoundError:
        if path.exists():  # another machine was first, beyond the reach of claims
            return index_shard(path)
        raise
    write_failures(rejections_of_shard(folder, name), failures)
    write_shard(path, samples)
    remove_staged(staged_folder)
    return index_shard(path)


def grow_shard(folder: DatasetFolder, name: str, scenes: range, held: int) -> ShardEntry | None:
    """Put a shard of all its scenes in the place of one that holds the first of them.

    Those are copied, byte for byte. Call in the turn of the manifest. The old shard can be read
    until the new one has its name; the note on the new one, which counts from then on, is there
    before, and the manifest follows.

    Args:
        folder: the dataset.
        name: file name of the shard.
        scenes: its scenes: those that it holds, and more that are staged.
        held: for how many of the scenes it stands.

    Returns:
        The new entry; None where the old bytes are not those that are known, so that from then on
        the manifest counts its scenes as missing.

    Raises:
        TrilightError: the disk is full or the folder cannot be written.
    """
    manifest, path = read_manifest(folder.manifest), folder.shard(name)
    known = {entry.name: entry for entry in manifest.shards}.get(name)
    if note_of(folder, name).exists():
        known = noted_shard(folder, name).shard
    if held and known and not _is_of(path, known):
        log.warning("%s: its bytes are not the noted ones; its scenes are made again", name)
        growing = {**manifest.growing, name: 0}
        write_manifest(folder.manifest, dataclasses.replace(manifest, growing=growing))
        return None
    end, added = sample_key(scenes.start + held), scenes[held:]
    old = itertools.takewhile(lambda sample: sample[0] < end, iterate_samples(path) if held else ())
    samples, failures = _read_staged(folder.staged_shard(name), added, old)
    write_failures(rejections_of_shard(folder, name), failures)
    with atomic_writer(path) as stream:
        write_tar(stream, samples)
        stream.flush()
        with Path(stream.name).open("rb") as written:
            shard = index_stream(written, path.name)
        note = encode_note(ShardNote(shard=shard, failures=tuple(failures)))
        write_atomically(note_of(folder, name), note)
    shards = tuple(shard if entry.name == name else entry for entry in manifest.shards)
    growing = {each: number for each, number in manifest.growing.items() if each != name}
    write_manifest(folder.manifest, dataclasses.replace(manifest, shards=shards, growing=growing))
    remove_staged(folder.staged_shard(name))
    return shard


def _is_of(path: Path, known: ShardEntry) -> bool:
    try:
        return index_shard(path) == known
    except TrilightError:
        return False


def _read_staged(
    folder: Path, indices: range, before: Iterable[tuple[str, dict[str, bytes]]] = ()
) -> tuple[Samples, list[Failure]]:
    """Return samples of a shard, those `before` first, and the staged ones' rejections."""
    samples, failures = Samples(before), list[Failure]()
    for index in indices:
        staged = read_staged_scene(folder, index)
        failures.extend(staged.failures)
        if staged.members:
            samples.append((sample_key(index), staged.members))
    maps: dict[str, bytes] = {}
    for _, members in samples:
        for member in filter(MAP_NAME.fullmatch, members):  # in memory once
            members[member] = maps.setdefault(member, members[member])
    return samples, failures


def remove_staged(staged_folder: Path) -> None:
    """Delete the staged scenes of a shard that is packed."""
    shutil.rmtree(staged_folder, ignore_errors=True)  # leftovers are never read
