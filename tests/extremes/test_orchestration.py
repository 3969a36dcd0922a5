"""How work is divided, at its ends: one range, too many workers, empty and broken ranges."""

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from pipeline.making.pipeline import make_dataset
from pipeline.making.run import ShardJob, TaskOutcome
from pipeline.making.runner import in_window
from pipeline.making.tasks import Piece
from storage.dataset.dataset import open_dataset
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from tests.for_each import case
from tests.pipeline.making.tiny_scenes_kit import Undocumented, tiny_order, without_rendering


@pytest.fixture
def scenes(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Split and number of each scene that is made, without objects and pictures."""
    return without_rendering(monkeypatch)


def test_ranges_of_one_shard_in_any_order_are_the_whole(
    tmp_path: Path, scenes: list[tuple[str, int]]
) -> None:
    make_dataset(tiny_order(out=str(tmp_path / "whole"), scenes=16), Undocumented())
    scenes.clear()
    finished = []
    for first in (2, 0, 3, 1):
        runner = Undocumented()
        part = tiny_order(out=str(tmp_path / "set"), scenes=16, shards=f"{first}:{first + 1}")
        outcome = make_dataset(part, runner)
        finished.append(runner.finished)
        assert [scene // 4 for _, scene in scenes[-4:]] == [first] * 4
    assert (outcome.num_shards, outcome.num_shards_planned) == (4, 4)
    assert finished == [0, 0, 0, 1]  # whoever makes the last one, and nobody else
    assert len(scenes) == 16
    whole = open_dataset(str(tmp_path / "whole"))
    assert outcome.digest == whole.digest == open_dataset(str(tmp_path / "set")).digest


class _Counting(Undocumented):
    """Says how many tasks were run."""

    def __init__(self) -> None:
        super().__init__()
        self.num_tasks = 0

    def run(self, tasks: Iterable[tuple[Piece, ...]], job: ShardJob) -> Iterator[TaskOutcome]:
        for outcome in super().run(tasks, job):
            self.num_tasks += 1
            yield outcome


@pytest.mark.parametrize("workers", [2, 64])
def test_more_workers_than_shards_or_scenes_do_no_harm(
    tmp_path: Path, scenes: list[tuple[str, int]], workers: int
) -> None:
    runner = _Counting()
    order = tiny_order(out=str(tmp_path / "set"), scenes=8, workers=workers)
    outcome = make_dataset(order, runner)
    assert sorted(scene for _, scene in scenes) == list(range(8))  # none twice
    assert 1 <= runner.num_tasks <= 8 and runner.finished == 1
    assert verify_dataset(tmp_path / "set").problems == []
    scenes.clear()
    plain = make_dataset(tiny_order(out=str(tmp_path / "plain"), scenes=8), Undocumented())
    assert outcome.digest == plain.digest


def test_as_many_makers_at_once_as_there_are_scenes(
    tmp_path: Path, scenes: list[tuple[str, int]]
) -> None:
    """Four runs on one folder, one range each or all of it: nothing is made twice."""

    def make(shards: str | None) -> str:
        order = tiny_order(out=str(tmp_path / "set"), scenes=4, shards=shards)
        return make_dataset(order, Undocumented()).digest

    with ThreadPoolExecutor(4) as makers:
        list(makers.map(make, (None, "0:1", None, "0:9")))
    assert sorted(scene for _, scene in scenes) == [0, 1, 2, 3]
    assert verify_dataset(tmp_path / "set").problems == []


def test_a_window_is_never_exceeded_and_needs_no_more_tasks_than_there_are() -> None:
    for window, number in ((1, 5), (5, 1), (1000, 3), (3, 0)):
        held: list[int] = []
        most = 0

        def submit(task: int) -> int:
            nonlocal most
            held.append(task)  # noqa: B023
            most = max(most, len(held))  # noqa: B023
            return task

        def result(task: int) -> int:
            held.remove(task)  # noqa: B023
            return task

        results = in_window(
            range(number), submit=submit, first_done=max, result=result, window=window
        )
        assert sorted(results) == list(range(number))
        assert most == min(window, number)


def test_empty_and_broken_ranges_are_refused_by_name() -> None:
    for shards in ("0:0", "3:3", "5:2", "-1:2", "0", ":", "0:1:2", "a:b", " 0:1"):
        with case(shards), pytest.raises(TrilightError) as caught:
            tiny_order(shards=shards)
        assert str(caught.value).startswith(f"shards is {shards!r}; expected a range such as 0:8")
        assert "\n" not in str(caught.value)


def test_a_range_beyond_the_end_is_refused_and_one_that_reaches_beyond_makes_what_is_there(
    tmp_path: Path, scenes: list[tuple[str, int]]
) -> None:
    for shards in ("2:3", "99999999999999999999:100000000000000000000"):
        order = tiny_order(out=str(tmp_path / "set"), scenes=8, shards=shards)
        expected = (
            f"^shards is '{shards}'; expected one that begins below 2, the shards of 8 scenes"
        )
        with pytest.raises(TrilightError, match=expected):
            make_dataset(order, Undocumented())
    assert scenes == []
    order = tiny_order(out=str(tmp_path / "set"), scenes=8, shards="1:10000")
    outcome = make_dataset(order, Undocumented())
    assert (outcome.num_shards, outcome.num_shards_planned) == (1, 2)
    assert [scene for _, scene in scenes] == [4, 5, 6, 7]
