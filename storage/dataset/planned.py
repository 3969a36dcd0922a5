"""Planned shards of a dataset, from its manifest alone."""

import contextlib

from storage.dataset.derived import derivation_of
from storage.dataset.manifest import Manifest, ShardEntry, number_of_shard
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import cut_splits, scenes_of_shard, shard_name, shards_for
from storage.errors import TrilightError, prefix_errors
from storage.settings.described import from_record


def planned_shards(manifest: Manifest) -> dict[str, int]:
    """Return the names of the shards of the finished dataset, with their numbers of scenes.

    Raises:
        TrilightError: the settings in the manifest do not say how the dataset is divided.
    """
    if derivation_of(manifest.settings):  # it only ever appears whole
        return {entry.name: entry.num_samples for entry in manifest.shards}
    splits = cut_splits(manifest.num_scenes, _splits(manifest))
    return {
        shard_name(index, splits): len(scenes_of_shard(index, splits))
        for index in range(shards_for(manifest.num_scenes, splits))
    }


def expected_scenes(manifest: Manifest) -> dict[str, int]:
    """Return `planned_shards`, less the scenes that were given up in the shards that are listed."""
    listed = {entry.name: entry.num_samples for entry in manifest.shards}
    grown = {name: count for name, count in listed.items() if name not in manifest.growing}
    return {name: grown.get(name, count) for name, count in planned_shards(manifest).items()}


def listed_scenes(manifest: Manifest) -> set[int]:
    """Return the scenes of the shards that are listed and do not grow, made or given up."""
    splits = cut_splits(manifest.num_scenes, _splits(manifest))
    full_shards = (entry for entry in manifest.shards if entry.name not in manifest.growing)
    return {
        scene for entry in full_shards for scene in scenes_of_shard(number_of_shard(entry), splits)
    }


def planned_scenes_of(manifest: Manifest, shard: ShardEntry) -> int | None:
    """Return how many scenes a shard is to hold; None for as many as fit into it."""
    splits = _splits(manifest)
    number = number_of_shard(shard)
    cut = scenes_of_shard(number, cut_splits(manifest.num_scenes, splits))
    return len(cut) if cut != scenes_of_shard(number, splits) else None


def is_whole(manifest: Manifest, num_listed: int) -> bool:
    """Return whether a manifest with so many finished shards has all, none of which still grows."""
    return not manifest.growing and num_listed >= num_planned(manifest)


def num_planned(manifest: Manifest) -> int:
    """Return how many shards there will be; of settings that do not say, those that are listed."""
    with contextlib.suppress(TrilightError):
        if not derivation_of(manifest.settings):
            return shards_for(manifest.num_scenes, _splits(manifest))
    return len(manifest.shards)


def _splits(manifest: Manifest) -> SplitSettings:
    with prefix_errors("manifest: settings.splits"):
        return from_record(SplitSettings, manifest.settings.get("splits"))
