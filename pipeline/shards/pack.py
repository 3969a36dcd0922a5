"""Stage "shards": the staged scenes of a shard become its tar file."""

import shutil
from pathlib import Path

from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import ShardEntry, index_shard
from storage.dataset.shard import write_shard
from storage.dataset.shard_notes import rejections_of_shard
from storage.dataset.staging import read_staged_scene
from storage.records.map_references import MAP_NAME
from storage.records.objects import Failure, write_failures
from storage.records.sample import sample_key


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
    staged_folder = folder.staged_shard(name)
    failures: list[Failure] = []
    samples: list[tuple[str, dict[str, bytes]]] = []
    maps: dict[str, bytes] = {}
    for index in scene_indices:
        try:
            staged = read_staged_scene(staged_folder, index)
        except FileNotFoundError:
            if folder.shard(name).exists():  # another machine was first, beyond the reach of claims
                return index_shard(folder.shard(name))
            raise
        failures.extend(staged.failures)
        if staged.members:
            for member in filter(MAP_NAME.fullmatch, staged.members):  # in memory once
                staged.members[member] = maps.setdefault(member, staged.members[member])
            samples.append((sample_key(index), staged.members))
    write_failures(rejections_of_shard(folder, name), failures)
    path = folder.shard(name)
    write_shard(path, samples)
    remove_staged(staged_folder)
    return index_shard(path)


def remove_staged(staged_folder: Path) -> None:
    """Delete the staged scenes of a shard that is packed."""
    shutil.rmtree(staged_folder, ignore_errors=True)  # leftovers are never read
