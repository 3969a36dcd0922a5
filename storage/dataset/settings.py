"""Settings of splits, shards and storage profiles.

They are apart from the code that reads shards, which does not import pydantic.
"""

import functools
import itertools
from typing import Annotated, ClassVar

from storage.conventions import SPLITS
from storage.dataset.splits import TEST_SLOT
from storage.errors import TrilightError, expected_one_of
from storage.records.passes import pass_names
from storage.records.profiles import Profile
from storage.settings.described import checked, leaves_out
from storage.settings.ranges import Within

MOST_SCENES = 1_000_000_000
"""Maximum number of scenes in a dataset: a sample's name has nine digits."""


@checked()
class ListedShard:
    """One shard of a dataset whose shards are those of another."""

    split: str
    """Its split: train, validation or test."""
    scenes: Annotated[int, Within(1, MOST_SCENES, unit="scenes")]
    """Number of its scenes."""

    def __post_init__(self) -> None:
        if self.split not in SPLITS:
            raise TrilightError(f"split is {self.split!r}; {expected_one_of(self.split, SPLITS)}.")


@checked()
class SplitSettings:
    """How objects and scenes are divided into splits and shards."""

    REMOVED: ClassVar = ("object_parts",)
    scenes_per_shard: Annotated[int, Within(1, 1_000_000, unit="scenes")]
    """Number of scenes in a shard; all of them belong to one split."""
    shards_per_cycle: Annotated[int, Within(TEST_SLOT + 1, 1_000_000, unit="shards")] = 8
    """Length of the cycle of splits: of this many consecutive shards, one is for validation and one
    for testing."""
    held_out_objects: Annotated[float, Within(0, 0.5, low_open=True, high_open=True)] = 0.125
    """Share of objects held out for validation; the same share is held out for testing."""
    one_split: bool = False
    """Put all objects and scenes into the split `test`, for a dataset that only serves evaluation.
    """
    listed_scenes: Annotated[int | None, Within(1, MOST_SCENES, unit="scenes")] = None
    """Number of scenes, if they come from scene files: the last shard may then hold fewer, and the
    dataset cannot grow."""
    listed_shards: tuple[ListedShard, ...] = ()
    """The shards, if the scenes are those of a finished dataset; by default there are none listed.
    The dataset cannot grow then."""

    _record = leaves_out("listed_shards")

    @functools.cached_property
    def first_scenes(self) -> tuple[int, ...]:
        """Index of the first scene of each listed shard, and of one beyond the last."""
        return (0, *itertools.accumulate(shard.scenes for shard in self.listed_shards))


@checked()
class StorageSettings:
    """How arrays and pictures are packed."""

    profile: Profile = "compact"
    """`lossless`, or `compact`: about five times smaller, and adds at most a tenth of the noise
    that a picture already has."""
    passes: tuple[str, ...] = ()
    """Passes to store beside each picture, such as [depth,normal,object]; by default none, since
    they can be computed from a stored scene at any time (reference page Passes)."""
    _record = leaves_out("passes")

    def __post_init__(self) -> None:
        object.__setattr__(self, "passes", pass_names(self.passes))
