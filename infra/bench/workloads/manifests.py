"""Writes datasets for measuring reading: copies of a few samples."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, ShardEntry, index_shard, write_manifest
from storage.dataset.shard import write_shard
from storage.records.sample import sample_key


def write_copies(
    root: Path, members: Sequence[Mapping[str, bytes]], *, copies: int = 16, per_shard: int = 16
) -> int:
    """Write a dataset that holds each sample under many keys; return the number of samples.

    Args:
        root: folder of the dataset; it may be missing.
        members: files of each sample by name.
        copies: number of keys of each sample.
        per_shard: number of samples of a shard.
    """
    folder = DatasetFolder(root)
    every = [(sample_key(k), members[k % len(members)]) for k in range(copies * len(members))]
    names = []
    for number, start in enumerate(range(0, len(every), per_shard)):
        names.append(f"train-{number:06d}.tar")
        write_shard(folder.shard(names[-1]), every[start : start + per_shard])
    _write_manifest(folder, len(every), [index_shard(folder.shard(name)) for name in names])
    return len(every)


def _write_manifest(folder: DatasetFolder, num_samples: int, shards: list[ShardEntry]) -> None:
    manifest = Manifest(
        build="bench", settings={}, environment={}, num_scenes=num_samples, num_views=4,
        objects_lock_sha256="", shards=tuple(shards),
    )  # fmt: skip
    write_manifest(folder.manifest, manifest)
