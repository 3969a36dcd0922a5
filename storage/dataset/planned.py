"""Planned shards of a dataset, and what it is made of, from its manifest alone.

The settings of a dataset that is made of finished ones are those that all of its sources agree on,
and one group `derived`: what was done, and each source's build, settings, digest and what was added
to its keys.
"""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from storage.dataset.manifest import Manifest, ShardEntry, number_of_shard
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import cut_splits, scenes_of_shard, shard_name, shards_for
from storage.errors import TrilightError, prefix_errors
from storage.settings.described import from_record

_GROUP = "derived"
_SOURCE_FIELDS = {"build", "digest", "key_offset", "num_scenes", "settings"}


@dataclass(frozen=True, kw_only=True)
class Derivation:
    """Operation and sources of a dataset that was made of others."""

    operation: str
    """One of merge, select and reshard."""
    arguments: Mapping[str, Any]
    sources: Sequence[Mapping[str, Any]]
    """Per source: build, num_scenes, digest, key_offset, settings."""


def derivation_of(settings: Mapping[str, Any]) -> Derivation | None:
    """Return what the settings of a dataset say of its sources; None where it was generated.

    Raises:
        TrilightError: they say it in another way.
    """
    if _GROUP not in settings:
        return None
    try:
        derivation = Derivation(**settings[_GROUP])
        for source in derivation.sources:
            if set(source) != _SOURCE_FIELDS or not isinstance(source["settings"], Mapping):
                raise ValueError(f"a source with {sorted(source)}")
    except (TypeError, ValueError) as error:
        raise TrilightError(f"manifest: settings.derived is not readable ({error}).") from error
    return derivation


def source_record(manifest: Manifest, *, key_offset: int) -> dict[str, Any]:
    """Return what a derivation says of one source; `key_offset` is added to the keys of it."""
    return {
        "build": manifest.build,
        "digest": manifest.dataset_digest,
        "key_offset": key_offset,
        "num_scenes": manifest.num_samples,
        "settings": dict(manifest.settings),
    }


def derived_settings(derivation: Derivation, *, scenes_per_shard: int | None) -> dict[str, Any]:
    """Return the settings of a derived dataset.

    Args:
        derivation: how it was made.
        scenes_per_shard: of its own shards, where they are not those of the sources.
    """
    of_sources = [source["settings"] for source in derivation.sources]
    shared = common(of_sources)
    shared.pop(_GROUP, None)  # the one of a source stands in the record of that source
    if scenes_per_shard is not None:
        shared["splits"] = {**shared.get("splits", {}), "scenes_per_shard": scenes_per_shard}
    return {**shared, _GROUP: asdict(derivation)}


def common(mappings: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the entries that all mappings agree on, group by group."""
    first, *rest = mappings
    agreed: dict[str, Any] = {}
    for name, value in first.items():
        values = [value, *(other.get(name) for other in rest)]
        if all(isinstance(entry, Mapping) for entry in values):
            agreed[name] = common(values)
        elif all(name in other for other in rest) and all(entry == value for entry in values):
            agreed[name] = value
    return agreed


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
