"""Which split an object and a scene belong to, from nothing but themselves.

An object's split is a hash of its cleaned geometry: copies under other names stay together, and
adding objects moves none. A scene's split is that of its shard, by the shard's number, so a longer
dataset begins with exactly the scenes of a shorter one.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from storage.conventions import SPLITS
from storage.errors import TrilightError
from storage.layout import numbered
from storage.ranges import Within, check_ranges

JUDGED_SPLIT = "test"
"""Split of whole sets that are judged by, never learnt from."""

_VALIDATION_SLOT, _TEST_SLOT = 2, 5
"""Places in a cycle of shards: early, so that a small dataset has all three splits."""

MOST_SCENES = 1_000_000_000
"""Of a dataset: a sample's name holds nine digits."""


@dataclass(frozen=True, kw_only=True)
class SplitSettings:
    """How objects and scenes are divided."""

    scenes_per_shard: Annotated[int, Within(1, 1_000_000, unit="scenes")]
    """Scenes in every shard; a shard holds one split."""
    shards_per_cycle: Annotated[int, Within(_TEST_SLOT + 1, 1_000_000, unit="shards")] = 8
    """Of this many shards in a row one is for validation and one is for testing."""
    held_out_objects: Annotated[float, Within(0, 0.5, low_open=True, high_open=True)] = 0.125
    """Share of objects kept for validation, and again for testing."""
    one_split: bool = False
    """All objects and scenes are of the split `test`: a set to be judged by."""
    listed_scenes: Annotated[int | None, Within(1, MOST_SCENES, unit="scenes")] = None
    """How many scenes there are where they come from files instead of being drawn: the last shard
    may hold fewer, and the dataset cannot grow."""

    def __post_init__(self) -> None:
        check_ranges(self)


def split_of_object(geometry_sha256: str, settings: SplitSettings) -> str:
    """Return the split of an object from the digest of its cleaned geometry (64 hex digits)."""
    if settings.one_split:
        return JUDGED_SPLIT
    position = int(geometry_sha256[:16], 16) / 2**64
    if position < settings.held_out_objects:
        return "validation"
    return "test" if position < 2 * settings.held_out_objects else "train"


def split_of_shard(shard_index: int, settings: SplitSettings) -> str:
    """Return the split of a shard from its number."""
    if settings.one_split:
        return JUDGED_SPLIT
    slot = shard_index % settings.shards_per_cycle
    return {_VALIDATION_SLOT: "validation", _TEST_SLOT: "test"}.get(slot, "train")


def shard_name(shard_index: int, settings: SplitSettings) -> str:
    """Return the name of a shard, such as `train-000003.tar`, relative to the dataset."""
    return named_shard(shard_index, split_of_shard(shard_index, settings))


def named_shard(shard_index: int, split: str) -> str:
    """Return the name of a shard of a split, relative to the dataset."""
    return numbered(shard_index, f"{split}-{shard_index:06d}.tar")


def scenes_of_shard(shard_index: int, settings: SplitSettings) -> range:
    """Return the indices of the scenes of a shard."""
    first = shard_index * settings.scenes_per_shard
    last = first + settings.scenes_per_shard
    if settings.listed_scenes is not None:
        last = min(last, settings.listed_scenes)
    return range(first, last)


def shard_of_scene(scene_index: int, settings: SplitSettings) -> str:
    """Return the name of the shard of a scene."""
    return shard_name(scene_index // settings.scenes_per_shard, settings)


def planned_scenes(num_scenes: int, settings: SplitSettings) -> int:
    """Return how many scenes are made when `num_scenes` are wanted: those of whole shards."""
    if settings.listed_scenes is not None:
        return settings.listed_scenes
    return shards_for(num_scenes, settings) * settings.scenes_per_shard


def shards_for(num_scenes: int, settings: SplitSettings) -> int:
    """Return how many shards hold at least `num_scenes` scenes."""
    return -(-num_scenes // settings.scenes_per_shard)


def require_objects(num_by_split: Mapping[str, int], needed: set[str]) -> None:
    """Raise TrilightError where a split that is needed has no object to draw from."""
    empty = [split for split in SPLITS if split in needed and not num_by_split.get(split)]
    if empty:
        total = sum(num_by_split.values())
        raise TrilightError(
            f"split {empty[0]!r}: none of the {total} accepted objects falls into it; expected at "
            "least 1, for which about 30 different objects are enough. Add objects (for example "
            "mix in `builtin:`), or make fewer scenes."
        )
