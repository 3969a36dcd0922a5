"""Rounds of a run: what others are at is waited for, seldom, without tasks; the budget holds."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

from pipeline.making import pipeline, tasks
from pipeline.making.dataset_order import DatasetOrder
from pipeline.making.freeze_objects import AcceptedObjects
from pipeline.making.pipeline import make_dataset
from pipeline.making.run import Run, ShardJob, TaskOutcome
from pipeline.making.tasks import Piece
from pipeline.making.unfinished_shard import UnfinishedShard
from pipeline.shards.pack import pack_shard
from storage.claims import claimed
from storage.dataset.layout import DatasetFolder
from storage.dataset.staging import stage_scene
from storage.dataset.statistics import Statistics
from storage.errors import TrilightError
from storage.records.objects import Failure
from storage.records.sample import sample_key
from tests.pipeline.making.test_publication import _build, _sample, begin_tiny, make_tiny_shard

FIRST = "train-000000.tar"


class Idle:
    """A runner that finds everything taken, and counts."""

    num_at_once = 1
    window = None

    def __init__(self) -> None:
        self.rounds: list[int] = []

    def run(self, tasks: Iterable[tuple[Piece, ...]], job: ShardJob) -> Iterator[TaskOutcome]:
        self.rounds.append(0)
        for _ in tasks:
            self.rounds[-1] += 1
            yield TaskOutcome(shards=(), scenes=0, seconds=0.0, core_s=0.0)

    def finish(self, write_documents: Callable[[], Statistics]) -> Statistics:
        raise AssertionError("not finished")


def _run(root: Path, scenes: int) -> Run:
    return Run(
        order=DatasetOrder(out=str(root), scenes=scenes),
        settings=_build(),
        listed=None,
        publication=begin_tiny(root, scenes),
        accepted=AcceptedObjects(num_objects=0, num_found=0),
    )


def _claim(folder: DatasetFolder, scene: int) -> Any:
    return claimed(folder.staged_shard(FIRST) / f"{sample_key(scene)}.claim")


def test_waiting_for_others_takes_few_looks_and_no_tasks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, runner, pauses = _run(tmp_path, 4), Idle(), list[float]()
    held = contextlib.ExitStack()

    def sleep(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) == 8:  # one of them dies: there is something to do
            held.close()
        if len(pauses) == 10:  # and somebody else was quicker
            make_tiny_shard(begin_tiny(tmp_path, 4), 0)

    monkeypatch.setattr(tasks.time, "sleep", sleep)
    for scene in range(4):
        held.enter_context(_claim(run.publication.folder, scene))
    pipeline.make_shards(run, runner, lambda run, outcome: None)
    assert pauses == [1, 2, 4, 8, 16, 32, 60, 60, 60, 60]
    assert runner.rounds == [1, 1, 1]  # at first, after the eighth pause, after the ninth


def test_a_range_leaves_to_others_what_they_are_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def sleep(seconds: float) -> None:
        raise AssertionError("nobody waits")

    monkeypatch.setattr(tasks.time, "sleep", sleep)
    run, runner = _run(tmp_path, 8), Idle()
    ranged = dataclasses.replace(run, order=dataclasses.replace(run.order, shards="0:1"))
    pipeline.make_shards(ranged, runner, lambda run, outcome: None)
    assert runner.rounds == [1]
    assert ranged.missing_shards() == [0]
    assert run.missing_shards() == [0, 1]


def test_what_is_free_is_what_nobody_is_at(tmp_path: Path) -> None:
    folder = DatasetFolder(tmp_path)
    shard = UnfinishedShard(folder, _build().splits, 0)
    assert shard.is_free()
    for scene in range(3):
        stage_scene(folder.staged_shard(FIRST), scene, _sample(scene), [], "lossless")
    with _claim(folder, 3):
        assert not shard.is_free()
    assert shard.is_free()
    stage_scene(folder.staged_shard(FIRST), 3, _sample(3), [], "lossless")
    assert shard.is_free()  # to be packed
    with claimed(folder.staged_shard(FIRST) / "pack.claim"):
        assert not shard.is_free()
    pack_shard(folder, FIRST, range(4))
    assert not shard.is_free()


def test_a_rerun_does_not_escape_the_failure_budget(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All shards are there, but an earlier run stopped since too many scenes were given up."""
    run = _run(tmp_path, 4)
    folder = run.publication.folder
    for scene in range(4):
        failure = Failure(stage="scenes", item=sample_key(scene), reason="no", message="x")
        stage_scene(folder.staged_shard(FIRST), scene, None, [failure], "lossless")
    run.publication.add_shard(pack_shard(folder, FIRST, range(4)))
    monkeypatch.setattr(pipeline, "_begun", lambda order: contextlib.nullcontext(run))
    with pytest.raises(TrilightError, match="4 of 4 scenes could not be made"):
        make_dataset(run.order, Idle())
