"""How work is cut: every scene once, few enough tasks, sizes that follow what was measured."""

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.making.dataset_order import DatasetOrder
from pipeline.making.tasks import MOST_TASKS, TASK_S, Piece, TaskSizes, TasksLeft, cut_tasks
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import scenes_of_shard
from storage.errors import EnvironmentFailure, TrilightError
from tests.for_each import for_each


def _scenes(tasks: list[tuple[Piece, ...]]) -> list[int]:
    return [scene for task in tasks for piece in task for scene in range(piece.first, piece.last)]


@given(
    shards=st.lists(st.integers(0, 5000), unique=True, max_size=60).map(sorted),
    per_shard=st.integers(1, 300),
    seconds=st.floats(0.01, 2000),
    most=st.integers(1, 50),
)
def test_every_scene_is_in_one_task(
    shards: list[int], per_shard: int, seconds: float, most: int
) -> None:
    splits, sizes = SplitSettings(scenes_per_shard=per_shard), TaskSizes()
    sizes.measured(1, seconds)
    tasks = list(cut_tasks(shards, splits, sizes, most=most))
    expected = [scene for shard in shards for scene in scenes_of_shard(shard, splits)]
    assert _scenes(tasks) == expected
    assert len(tasks) <= most
    for task in tasks:
        for piece in task:
            scenes = scenes_of_shard(piece.shard_index, splits)
            assert scenes.start <= piece.first < piece.last <= scenes.stop


def test_a_task_takes_the_time_that_it_should() -> None:
    """At 10 s a scene 24 of them: half a shard of 48, or six of 4."""
    sizes = TaskSizes()
    sizes.measured(3, 30.0)
    for per_shard, pieces in ((48, 1), (4, 6)):
        tasks = list(cut_tasks(range(24), SplitSettings(scenes_per_shard=per_shard), sizes))
        assert len(_scenes(tasks[:1])) == TASK_S / 10
        assert len(tasks[0]) == pieces


def test_sizes_follow_what_is_measured_on_the_way() -> None:
    sizes = TaskSizes()
    tasks = cut_tasks(range(100), SplitSettings(scenes_per_shard=4), sizes)
    assert len(_scenes([next(tasks)])) == 4
    next(tasks)  # was cut when the first was handed out
    sizes.measured(4, 4.0)
    assert len(_scenes([next(tasks)])) == TASK_S


@for_each("at_once", [2, 8])
def test_several_at_once_all_have_work_until_the_end(at_once: int) -> None:
    """Fast scenes, of which one task could take all: nobody gets more than half of a share."""
    sizes = TaskSizes()
    sizes.measured(4, 1.0)
    left = 256
    for task in cut_tasks(range(64), SplitSettings(scenes_per_shard=4), sizes, at_once=at_once):
        size = len(_scenes([task]))
        assert size <= max(1, left / (2 * at_once))
        left -= size
    assert left == 0


def test_two_million_slow_scenes_are_at_most_a_thousand_tasks() -> None:
    sizes = TaskSizes()
    sizes.measured(1, 100.0)
    splits = SplitSettings(scenes_per_shard=256)
    assert sum(1 for _ in cut_tasks(range(2_000_000 // 256), splits, sizes)) <= MOST_TASKS


def test_all_rounds_of_a_run_are_at_most_a_thousand_tasks() -> None:
    splits, left, rounds = SplitSettings(scenes_per_shard=1), TasksLeft(), list[int]()
    with pytest.raises(EnvironmentFailure, match="run the same command again"):
        while True:
            rounds.append(sum(1 for _ in left.cut(range(5000), splits, TaskSizes(), at_once=1)))
    assert rounds[:2] == [900, 90]
    assert sum(rounds) == MOST_TASKS


@for_each(
    ("changes", "message"),
    [
        ({"build": "nonsense"}, "build 'nonsense'"),
        ({"scenes": 0}, "scenes is 0"),
        ({"workers": 0}, "workers is 0"),
        ({"failure_budget": 1.5}, "failure_budget is 1.5"),
        ({"shards": "4"}, "shards is '4'"),
        ({"shards": "4:4"}, "shards is '4:4'"),
        ({"views": 2}, "--views is 2"),
        ({"scenes_from": "a", "scenes": 3}, "expected neither"),
    ],
)
def test_wrong_orders_are_named(changes: dict[str, object], message: str) -> None:
    with pytest.raises(TrilightError, match=message):
        dataclasses.replace(DatasetOrder(), **changes)  # type: ignore[arg-type]
    assert DatasetOrder(shards="4:7").shard_range() == range(4, 7)
