"""How a dataset is divided and packed: settings, apart from what reads shards without pydantic."""

from typing import Annotated

from storage.dataset.splits import TEST_SLOT
from storage.records.profiles import Profile
from storage.settings.described import checked
from storage.settings.ranges import Within

MOST_SCENES = 1_000_000_000
"""Maximum number of scenes in a dataset: a sample's name has nine digits."""


@checked()
class SplitSettings:
    """How objects and scenes are divided."""

    scenes_per_shard: Annotated[int, Within(1, 1_000_000, unit="scenes")]
    """Scenes in every shard; a shard holds one split."""
    shards_per_cycle: Annotated[int, Within(TEST_SLOT + 1, 1_000_000, unit="shards")] = 8
    """Of this many shards in a row one is for validation and one is for testing."""
    held_out_objects: Annotated[float, Within(0, 0.5, low_open=True, high_open=True)] = 0.125
    """Share of objects kept for validation, and again for testing."""
    one_split: bool = False
    """All objects and scenes are of the split `test`: a set to be judged by."""
    listed_scenes: Annotated[int | None, Within(1, MOST_SCENES, unit="scenes")] = None
    """How many scenes there are where they come from files instead of being drawn: the last shard
    may hold fewer, and the dataset cannot grow."""


@checked()
class StorageSettings:
    """How a dataset is packed."""

    profile: Profile = "compact"
    """`lossless`, or `compact`: about five times smaller, within the law of the tenth."""
