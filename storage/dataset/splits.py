"""Splits (train, validation, test) of objects and scenes, each from its own identity alone.

An object's split is a hash of its cleaned geometry: copies under other names stay together, so no
object leaks from one split into another, and adding objects moves none. A scene's split is that of
its shard, by the shard's number, so a longer dataset begins with exactly the scenes of a shorter
one. Where the shards are listed, since they are those of another dataset, the list says both.
"""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING

from storage.conventions import SPLITS
from storage.dataset.layout import numbered_path
from storage.errors import TrilightError

if TYPE_CHECKING:
    from storage.dataset.settings import SplitSettings

JUDGED_SPLIT = "test"
"""Split of whole sets that are judged by, never learnt from."""

VALIDATION_SLOT = 2
TEST_SLOT = 5
"""Places in a cycle of shards: early, so that a small dataset has all three splits."""


def split_of_object(geometry_sha256: str, settings: "SplitSettings") -> str:
    """Return the split of an object from the digest of its cleaned geometry (64 hex digits)."""
    if settings.one_split:
        return JUDGED_SPLIT
    position = int(geometry_sha256[:16], 16) / 2**64
    if position < settings.held_out_objects:
        return "validation"
    return "test" if position < 2 * settings.held_out_objects else "train"


def split_of_shard(shard_index: int, settings: "SplitSettings") -> str:
    """Return the split of a shard from its number."""
    if settings.listed_shards:
        return settings.listed_shards[shard_index].split
    if settings.one_split:
        return JUDGED_SPLIT
    slot = shard_index % settings.shards_per_cycle
    return {VALIDATION_SLOT: "validation", TEST_SLOT: "test"}.get(slot, "train")


def shard_name(shard_index: int, settings: "SplitSettings") -> str:
    """Return the name of a shard, such as `train-000003.tar`, relative to the dataset."""
    return named_shard(shard_index, split_of_shard(shard_index, settings))


def named_shard(shard_index: int, split: str) -> str:
    """Return the name of a shard of a split, relative to the dataset."""
    return numbered_path(shard_index, f"{split}-{shard_index:06d}.tar")


def scenes_of_shard(shard_index: int, settings: "SplitSettings") -> range:
    """Return the indices of the scenes of a shard."""
    if settings.listed_shards:
        return range(*settings.first_scenes[shard_index : shard_index + 2])
    first = shard_index * settings.scenes_per_shard
    last = first + settings.scenes_per_shard
    if settings.listed_scenes is not None:
        last = min(last, settings.listed_scenes)
    return range(first, last)


def planned_scenes(num_scenes: int, settings: "SplitSettings") -> int:
    """Return how many scenes are made when `num_scenes` are wanted: those, unless files say it."""
    if settings.listed_shards:
        return settings.first_scenes[-1]
    return num_scenes if settings.listed_scenes is None else settings.listed_scenes


def cut_splits(num_scenes: int, settings: "SplitSettings") -> "SplitSettings":
    """Return settings whose last shard ends with the last of `num_scenes` scenes."""
    if settings.listed_shards:
        return settings
    return dataclasses.replace(settings, listed_scenes=planned_scenes(num_scenes, settings))


MOST_SHARDS = 1_000_000
"""Maximum number of shards in a dataset: a shard's name has six digits."""


def shards_for(num_scenes: int, settings: "SplitSettings") -> int:
    """Return how many shards hold at least `num_scenes` scenes.

    Raises:
        TrilightError: more than MOST_SHARDS.
    """
    if settings.listed_shards:
        return len(settings.listed_shards)
    count = -(-num_scenes // settings.scenes_per_shard)
    if count > MOST_SHARDS:
        raise TrilightError(
            f"scenes: {num_scenes} in shards of {settings.scenes_per_shard} are {count} shards; "
            f"expected at most {MOST_SHARDS}. Raise splits.scenes_per_shard, or make fewer scenes."
        )
    return count


def lacks_validation(num_scenes: int, settings: "SplitSettings") -> str:
    """Say that no shard of new scenes is for validation, where that is so; empty otherwise."""
    if settings.one_split or settings.listed_shards or settings.listed_scenes is not None:
        return ""
    least = VALIDATION_SLOT * settings.scenes_per_shard + 1
    return "" if num_scenes >= least else f"no shard is for validation before --scenes {least}"


def keeps_scenes(num_scenes: int, requested: int | None, settings: "SplitSettings") -> str:
    """Say that a dataset keeps its scenes, where fewer are requested; empty otherwise."""
    if requested is None or planned_scenes(requested, settings) >= num_scenes:
        return ""
    return f"the dataset keeps its {num_scenes} scenes; for {requested}, choose another --out"


def require_objects(num_by_split: Mapping[str, int], required_splits: set[str]) -> None:
    """Raise TrilightError where a split that is needed has no object to draw from."""
    empty = [split for split in SPLITS if split in required_splits and not num_by_split.get(split)]
    if empty:
        total = sum(num_by_split.values())
        raise TrilightError(
            f"split {empty[0]!r}: none of the {total} accepted objects falls into it; expected at "
            "least 1, for which about 30 different objects are enough. Add objects, or make fewer "
            "scenes."
        )
