"""What falls to a task of a Slurm array, by the variables that Slurm's manual promises."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.executors.registry import find_executor
from pipeline.executors.slurm import shards_of_task
from storage.dataset.dataset import open_dataset
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.pipeline.making.tiny_scenes_kit import Undocumented, tiny_order, without_rendering


def _array(task: int, first: int, last: int, count: int, **more: str) -> dict[str, str]:
    numbers = {"ID": task, "MIN": first, "MAX": last, "COUNT": count}
    return {f"SLURM_ARRAY_TASK_{name}": str(value) for name, value in numbers.items()} | more


def _shards(number: int) -> Callable[[], int]:
    return lambda: number


def test_the_tasks_of_an_array_have_equal_shares() -> None:
    assert [shards_of_task(_array(k, 0, 3, 4), _shards(10)) for k in range(4)] == [
        "0:2", "2:5", "5:7", "7:10",
    ]  # fmt: skip
    by_two = [shards_of_task(_array(k, 1, 5, 3), _shards(6)) for k in (1, 3, 5)]  # --array=1-5:2
    assert by_two == ["0:2", "2:4", "4:6"]
    assert shards_of_task(_array(7, 7, 7, 1), _shards(6)) == "0:6"


def test_more_tasks_than_shards_share_them() -> None:
    shares = [shards_of_task(_array(k, 0, 4, 5), _shards(2)) for k in range(5)]
    assert shares == ["0:1", "1:2", "0:1", "1:2", "0:1"]


def test_a_stated_number_of_shards_depends_on_the_task_alone() -> None:
    """A single task can be submitted again; the dataset need not even be begun."""

    def unknown() -> int:
        raise AssertionError("nobody needs to know")

    alone = {"SLURM_ARRAY_TASK_ID": "2", "SHARDS_PER_TASK": "4"}
    assert shards_of_task(alone, unknown) == "8:12"


@for_each(
    ("environment", "message"),
    [
        ({}, r"SLURM_ARRAY_TASK_ID is not set; expected a task of a Slurm array\. Submit"),
        (_array(3, 3, 7, 2, SHARDS_PER_TASK="0"), "SHARDS_PER_TASK is '0'; expected .* from 1"),
        (_array(0, 0, 0, 1) | {"SLURM_ARRAY_TASK_ID": "x"}, "ID is 'x'; expected a number from 0"),
        (_array(3, 0, 7, 3), r"3 tasks between 0 and 7, with gaps; .* Or set SHARDS_PER_TASK"),
        (_array(2, 0, 9, 4), r"4 tasks between 0 and 9, with gaps"),  # 0, 2, 5, 9
    ],
)
def test_what_is_no_array_is_named(environment: dict[str, str], message: str) -> None:
    with pytest.raises(TrilightError, match=message):
        shards_of_task(environment, _shards(8))


def test_an_array_makes_the_dataset_that_one_process_makes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tasks run in any order; whoever makes the last shard finishes."""
    scenes = without_rendering(monkeypatch)
    finished = Undocumented()
    monkeypatch.setattr("pipeline.executors.slurm.ThreadRunner", lambda: finished)
    monkeypatch.setattr("pipeline.executors.threads.ThreadRunner", Undocumented)
    alone, shared = (tiny_order(out=str(tmp_path / name), scenes=12) for name in ("one", "set"))
    find_executor("threads", None, None).make(alone, None)
    slurm = find_executor("slurm", None, None)
    for task in (2, 0, 1):
        assert finished.finished == 0
        for name, value in _array(task, 0, 2, 3).items():
            monkeypatch.setenv(name, value)
        slurm.make(shared, None)
    assert finished.finished == 1
    assert len(scenes) == 24
    assert verify_dataset(tmp_path / "set").problems == []
    one, array = (open_dataset(str(tmp_path / name)) for name in ("one", "set"))
    assert array.digest == one.digest
    with pytest.raises(TrilightError, match="--shards is 0:2; expected none with --runner slurm"):
        slurm.make(dataclasses.replace(shared, shards="0:2"), None)
