"""Pieces of shards by several makers: every scene once, one packer; rounds wait for others."""

import contextlib
import dataclasses
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from PIL import Image

from pipeline.generation import generation_run, pipeline, render_workers
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.generation_run import Piece, Run, Runner, ShardJob, TaskResult
from pipeline.generation.pipeline import make_dataset, make_piece
from pipeline.generation.scene_worker import SceneAttempt
from pipeline.isolation import ChildFailed
from pipeline.shards import pack_shards as pack
from pipeline.shards.pack_shards import UnfinishedShard, pack_shard
from storage import file_locks
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import ShardEntry, index_shard
from storage.dataset.progress import read_progress, read_status
from storage.dataset.shard import write_shard
from storage.dataset.staging import ShardNote, is_staged, note_shard, noted_shard, read_staged_scene
from storage.dataset.statistics import Statistics
from storage.errors import TrilightError
from storage.file_locks import hold_lock
from storage.records.objects import Failure, read_failures
from storage.records.sample import sample_key
from tests.pipeline.generation.test_dataset_writer import (
    _build,
    _sample,
    begin_tiny,
    make_tiny_shard,
)
from tests.pipeline.generation.tiny_scenes_kit import shard_job
from tests.scenes_by_hand import stage_scene

NAME = "train-000000.tar"


@pytest.fixture(autouse=True)
def _begun(tmp_path: Path) -> None:
    """Begin the dataset whose shard this is."""
    begin_tiny(tmp_path, 4)


def _make(root: Path, first: int, last: int, made: "Counter[int]", broken: int = -1) -> Any:
    """Make a piece with a child that makes tiny samples at once, and counts."""

    def attempt(method: Any, split: str, scene_index: int, attempt: int) -> SceneAttempt:
        if scene_index == broken and attempt == 0:
            raise ChildFailed("crashed_signal_11", "native code ended by SIGSEGV")
        made[scene_index] += 1
        return SceneAttempt(sample=_sample(scene_index), failures=[])

    child: Any = SimpleNamespace(call_method=attempt)
    piece = Piece(shard_index=0, first=first, last=last)
    _, shard = make_piece(shard_job(root), piece, child)
    return shard


def test_many_makers_of_one_shard_make_every_scene_once(tmp_path: Path) -> None:
    made: Counter[int] = Counter()
    with ThreadPoolExecutor(6) as makers:
        packed = list(makers.map(lambda _: _make(tmp_path, 0, 4, made), range(6)))
    assert made == {0: 1, 1: 1, 2: 1, 3: 1}
    (shard,) = [entry for entry in packed if entry]
    assert shard == index_shard(tmp_path / NAME)
    assert not list(tmp_path.rglob("*.part"))


def test_whoever_makes_the_last_piece_packs_and_what_somebody_else_is_making_is_left_to_them(
    tmp_path: Path,
) -> None:
    made: Counter[int] = Counter()
    assert _make(tmp_path, 2, 4, made) is None
    with _claim(DatasetFolder(tmp_path), 1):
        assert _make(tmp_path, 0, 4, made) is None
    assert made == {0: 1, 2: 1, 3: 1}
    shard = _make(tmp_path, 0, 2, made)  # they died; now it is free
    assert shard is not None
    assert shard.num_samples == 4
    assert _make(tmp_path, 0, 4, made) is None  # there is nothing left to do
    assert made.total() == 4


def test_the_first_scene_can_be_looked_at_at_once(tmp_path: Path) -> None:
    sheet, made = DatasetFolder(tmp_path).contact_sheet, Counter[int]()
    _make(tmp_path, 2, 3, made)
    first = sheet.read_bytes()
    assert Image.open(sheet).size[0] > 2 * 192, "both views side by side"
    _make(tmp_path, 3, 4, made)
    assert sheet.read_bytes() == first, "later scenes leave it"


def test_who_waits_for_others_says_for_whom(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(file_locks, "_SILENT_S", 0.0)
    folder, missing = DatasetFolder(tmp_path), [[0], [0], []]
    writer = SimpleNamespace(folder=folder)
    run: Any = SimpleNamespace(
        publication=writer, job=shard_job(tmp_path), unfinished_shards=lambda: missing.pop(0)
    )
    _make(tmp_path, 1, 4, Counter())
    with _claim(folder, 0):
        generation_run.wait_for_others(run, 0.0)
    assert f"{sample_key(0)}.claim: waiting for 0 s for process {os.getpid()} of" in caplog.text


def test_a_shard_that_is_packed_while_one_looks_is_not_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its scenes leave the staging then: they are neither staged nor claimed, and yet not free."""
    looked_at = UnfinishedShard(DatasetFolder(tmp_path), _build().splits, 0)
    assert looked_at.is_free()

    def packed_meanwhile(staged: Path, scene_index: int) -> bool:
        seen = is_staged(staged, scene_index)
        monkeypatch.setattr(pack, "is_staged", is_staged)
        assert _make(tmp_path, 0, 4, Counter()) is not None
        return seen

    monkeypatch.setattr(pack, "is_staged", packed_meanwhile)
    assert not looked_at.is_free()


def _somebody_quicker(
    monkeypatch: pytest.MonkeyPatch, claim_name: str, work: Callable[[], object]
) -> None:
    """Let somebody else do `work` just before this process asks for a claim."""

    @contextlib.contextmanager
    def claimed_late(claim: Path) -> Iterator[bool]:
        if claim.name == claim_name:
            monkeypatch.setattr(pack, "hold_lock", hold_lock)
            work()
        with hold_lock(claim) as ours:
            yield ours

    monkeypatch.setattr(pack, "hold_lock", claimed_late)


def test_a_scene_that_somebody_made_before_the_claim_is_not_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And a shard that somebody packed before the claim has one packer."""
    made: Counter[int] = Counter()
    packed: list[ShardEntry | None] = []
    _somebody_quicker(monkeypatch, f"{sample_key(0)}.claim", lambda: _make(tmp_path, 0, 1, made))
    _make(tmp_path, 0, 1, made)
    assert made == {0: 1}
    _somebody_quicker(monkeypatch, "pack.claim", lambda: packed.append(_make(tmp_path, 0, 4, made)))
    packed.append(_make(tmp_path, 0, 4, made))
    assert [entry is not None for entry in packed] == [True, False]
    assert made.total() == 4


def test_a_scene_that_crashes_its_child_costs_an_attempt(tmp_path: Path) -> None:
    made: Counter[int] = Counter()
    assert _make(tmp_path, 0, 2, made, broken=1) is None
    staged = DatasetFolder(tmp_path).staged_shard(NAME)
    _, (failure,) = read_staged_scene(staged, 1)
    assert (failure.reason, failure.attempt) == ("environmental_skip", 0)
    assert "SIGSEGV" in failure.message


def test_a_note_of_an_earlier_shard_is_not_believed(tmp_path: Path) -> None:
    folder = DatasetFolder(tmp_path)
    write_shard(tmp_path / NAME, [(sample_key(0), {"json": b"{}"})])
    before = ShardNote(shard=index_shard(tmp_path / NAME), failures=())
    note_shard(folder, before)
    assert noted_shard(folder, NAME) == before
    (tmp_path / NAME).unlink()
    write_shard(tmp_path / NAME, [(sample_key(0), {"json": b"[]"})])  # of the same size
    assert noted_shard(folder, NAME).shard == index_shard(tmp_path / NAME) != before.shard


class Idle(Runner[Any]):
    """A runner that finds everything taken, and counts."""

    num_at_once = 1

    def __init__(self) -> None:
        self.rounds: list[int] = []

    def run(self, tasks: Iterable[tuple[Piece, ...]], job: ShardJob) -> Iterator[TaskResult]:
        self.rounds.append(0)
        yield from super().run(tasks, job)

    def submit(self, task: tuple[Piece, ...], job: ShardJob) -> Any:
        self.rounds[-1] += 1
        done = Future[TaskResult]()
        done.set_result(TaskResult(shards=(), scenes=0, seconds=0.0, core_s=0.0))
        return done

    def wait_any(self, running: list[Any]) -> Any:
        return running[0]

    def finish(self, write_documents: Callable[[], Statistics]) -> Statistics:
        raise AssertionError("not finished")


def _run(root: Path, scenes: int) -> Run:
    return Run(
        options=GenerateOptions(out=str(root), scenes=scenes),
        publication=begin_tiny(root, scenes),
        job=shard_job(root),
    )


def _claim(folder: DatasetFolder, scene: int) -> Any:
    return hold_lock(folder.staged_shard(NAME) / f"{sample_key(scene)}.claim")


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

    monkeypatch.setattr(generation_run.time, "sleep", sleep)
    for scene in range(4):
        held.enter_context(_claim(run.publication.folder, scene))
    pipeline.make_shards(run, runner, lambda run, outcome: None)
    assert pauses == [1, 2, 4, 8, 16, 32, 60, 60, 60, 60]
    assert runner.rounds == [1, 1, 1]  # at first, after the eighth pause, after the ninth


def test_a_range_leaves_to_others_what_they_are_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generation_run.time, "sleep", None)  # nobody waits
    run, runner = _run(tmp_path, 8), Idle()
    ranged = dataclasses.replace(run, options=dataclasses.replace(run.options, shards="0:1"))
    pipeline.make_shards(ranged, runner, lambda run, outcome: None)
    assert runner.rounds == [1]
    assert ranged.unfinished_shards() == [0]
    assert run.unfinished_shards() == [0, 1]


def test_what_is_free_is_what_nobody_is_at(tmp_path: Path) -> None:
    folder = DatasetFolder(tmp_path)
    shard = UnfinishedShard(folder, _build().splits, 0)
    assert shard.is_free()
    for scene in range(3):
        stage_scene(folder.staged_shard(NAME), scene, _sample(scene), [], "lossless")
    with _claim(folder, 3):
        assert not shard.is_free()
    assert shard.is_free()
    stage_scene(folder.staged_shard(NAME), 3, _sample(3), [], "lossless")
    assert shard.is_free()  # to be packed
    with hold_lock(folder.staged_shard(NAME) / "pack.claim"):
        assert not shard.is_free()
    pack_shard(folder, NAME, range(4))
    assert not shard.is_free()


def test_a_rerun_does_not_escape_the_failure_budget(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All shards are there, but an earlier run stopped since too many scenes were given up."""
    run = _run(tmp_path, 4)
    folder = run.publication.folder
    for scene in range(4):
        failure = Failure(stage="scenes", item=sample_key(scene), reason="no", message="x")
        stage_scene(folder.staged_shard(NAME), scene, None, [failure], "lossless")
    run.publication.add_shard(pack_shard(folder, NAME, range(4)))
    with pytest.raises(TrilightError, match=r"4 of 4 .*The reasons are in failures\.jsonl"):
        run.require_within_budget()  # while it is made
    assert [row.item for row in read_failures(folder.failures)] == [*map(sample_key, range(4))]
    monkeypatch.setattr(pipeline, "begin_run", lambda order: contextlib.nullcontext(run))
    with pytest.raises(TrilightError, match="4 of 4 scenes could not be made"):
        make_dataset(run.options, Idle())


def test_scenes_that_are_given_up_are_not_counted_as_made(tmp_path: Path) -> None:
    """While they wait, in a shard that is not listed, and in a finished dataset."""
    run = _run(tmp_path, 4)
    folder = run.publication.folder
    shard = UnfinishedShard(folder, run.job.settings.splits, 0)
    for scene in range(4):
        made = _sample(scene) if scene else None
        shard.stage(scene, made, [], "lossless", began=0.0, cores=1)
    shard.stage(0, None, [], "lossless", began=0.0, cores=1)  # again, after a kill

    def counts() -> set[tuple[int, int, int]]:
        shown = read_progress(folder), read_status(str(folder.root))
        return {(now.scenes_done, now.scenes_given_up, now.scenes_planned) for now in shown}

    assert counts() == {(3, 1, 4)}
    packed = shard.pack()
    assert packed is not None
    run.publication.add_shard(packed)
    assert counts() == {(3, 1, 4)}
    run.publication.finish()
    assert counts() == {(3, 1, 4)}


def test_only_children_that_nobody_uses_are_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another run may be at work on the same Dask worker."""
    closed: list[str] = []

    def children(name: str) -> SimpleNamespace:
        lent = SimpleNamespace(borrow=lambda: contextlib.nullcontext("child"))
        return SimpleNamespace(
            num_users=0, renderers=lent, readers=None, close=lambda: closed.append(name)
        )

    job = cast(Any, SimpleNamespace(
        folder=DatasetFolder(Path("a")), settings=SimpleNamespace(digest="d"), lock_sha256="l",
        device="cpu",
    ))  # fmt: skip
    monkeypatch.setattr(render_workers, "_jobs", {("b", "d", "l"): children("other")})
    monkeypatch.setattr(render_workers, "_JobChildren", lambda job: children("ours"))
    with render_workers.job_children(job) as lent:
        assert lent == ("child", None)
        assert closed == ["other"]
        render_workers.close_children(of_idle_jobs=True)
        assert closed == ["other"]
    render_workers.close_children(of_idle_jobs=True)
    assert closed == ["other", "ours"]
