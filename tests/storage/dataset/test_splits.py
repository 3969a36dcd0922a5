"""Splits depend on nothing but the thing itself, and growing a dataset moves nothing."""

import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from storage.conventions import SPLITS
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import (
    require_objects,
    scenes_of_shard,
    shard_name,
    shards_for,
    split_of_object,
    split_of_shard,
)
from storage.errors import TrilightError
from storage.seeds import rng_for, seed_for
from tests.for_each import for_each

SETTINGS = SplitSettings(scenes_per_shard=4)
shard_indices = st.integers(0, 10_000)


def _geometry(number: int) -> str:
    return hashlib.sha256(str(number).encode()).hexdigest()


def test_shares_of_objects_are_as_stated() -> None:
    splits = [split_of_object(_geometry(i), SETTINGS) for i in range(4000)]
    for split, share in (("train", 0.75), ("validation", 0.125), ("test", 0.125)):
        # 4000 draws: a standard error of at most 0.007, so 0.03 is over four of them
        assert abs(splits.count(split) / 4000 - share) < 0.03


@given(shard_indices)
def test_scenes_are_divided_without_gap_or_overlap(index: int) -> None:
    here, following = scenes_of_shard(index, SETTINGS), scenes_of_shard(index + 1, SETTINGS)
    assert here.stop == following.start
    assert len(here) == SETTINGS.scenes_per_shard


@given(st.integers(1, 100_000), st.integers(1, 300))
def test_whole_shards_hold_every_scene(num_scenes: int, scenes_per_shard: int) -> None:
    settings = SplitSettings(scenes_per_shard=scenes_per_shard)
    count = shards_for(num_scenes, settings)
    assert (count - 1) * scenes_per_shard < num_scenes <= count * scenes_per_shard


@given(st.integers(0, 1000))
def test_every_cycle_has_each_split(cycle: int) -> None:
    first = cycle * SETTINGS.shards_per_cycle
    splits = [split_of_shard(first + i, SETTINGS) for i in range(SETTINGS.shards_per_cycle)]
    assert set(splits) == set(SPLITS)
    assert splits.count("validation") == splits.count("test") == 1


def test_a_small_dataset_has_all_splits() -> None:
    names = [shard_name(index, SETTINGS) for index in range(shards_for(24, SETTINGS))]
    assert {name.split("-")[0] for name in names} == set(SPLITS)


def test_a_split_without_objects_is_one_clear_line() -> None:
    with pytest.raises(TrilightError, match="split 'validation': none of the 5"):
        require_objects({"train": 5}, {"train", "validation"})
    require_objects({"train": 5}, {"train"})


@for_each(
    "changes",
    [{"scenes_per_shard": 0}, {"shards_per_cycle": 5}, {"held_out_objects": 0.5}],
)
def test_settings_out_of_range_are_named(changes: dict[str, float]) -> None:
    with pytest.raises(TrilightError, match=next(iter(changes))):
        SplitSettings(**{"scenes_per_shard": 4, **changes})  # type: ignore[arg-type]


def test_randomness_has_a_name() -> None:
    first = rng_for(0, "scene", 7, 0).random(4)
    assert (rng_for(0, "scene", 7, 0).random(4) == first).all()
    others = [rng_for(0, "scene", 7, 1), rng_for(1, "scene", 7, 0), rng_for(0, "camera", 7, 0)]
    assert all((other.random(4) != first).all() for other in others)
    assert rng_for(0, "scene", 70).random() != rng_for(0, "scene", 7, 0).random()
    assert 0 <= seed_for(0, "samples", 1) < 2**31
