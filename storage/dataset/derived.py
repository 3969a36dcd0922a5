"""Datasets that are made of finished datasets: what their manifest says about where they are from.

The settings of such a dataset are those that all of its sources agree on, and one group `derived`:
what was done, and each source's build, settings, digest and what was added to its keys.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from storage.dataset.manifest import Manifest
from storage.errors import TrilightError

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
