"""Which shards a dataset will have, from its manifest alone."""

from storage.dataset.derived import derivation_of
from storage.dataset.manifest import Manifest
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import scenes_of_shard, shard_name, shards_for
from storage.errors import TrilightError
from storage.settings.described import from_record


def planned_shards(manifest: Manifest) -> dict[str, int]:
    """Return the names of the shards of the finished dataset, with their numbers of scenes.

    Of a shard that is listed, that is how many it holds.

    Raises:
        TrilightError: the settings in the manifest do not say how the dataset is divided.
    """
    if derivation_of(manifest.settings):  # it only ever appears whole
        return {entry.name: entry.num_samples for entry in manifest.shards}
    splits = _splits(manifest)
    planned = {
        shard_name(index, splits): len(scenes_of_shard(index, splits))
        for index in range(shards_for(manifest.num_scenes, splits))
    }
    held = {entry.name: entry.num_samples for entry in manifest.shards}
    return {name: held.get(name, count) for name, count in planned.items()}


def num_planned(manifest: Manifest) -> int:
    """Return how many shards there will be; of settings that do not say, those that are listed."""
    try:
        if derivation_of(manifest.settings):
            return len(manifest.shards)
        return shards_for(manifest.num_scenes, _splits(manifest))
    except TrilightError:
        return len(manifest.shards)


def _splits(manifest: Manifest) -> SplitSettings:
    try:
        return from_record(SplitSettings, manifest.settings["splits"])
    except (KeyError, TrilightError) as error:
        raise TrilightError(f"manifest: settings.splits is not readable ({error!r}).") from error
