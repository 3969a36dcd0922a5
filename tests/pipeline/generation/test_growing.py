"""Work is ordered and cut; a dataset that is grown by any steps is the one made at once."""

import contextlib
import itertools
import json
import os
import shutil
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infra.cli.overrides import parse_overrides
from pipeline.generation import pipeline
from pipeline.generation.generate_options import GenerateOptions, generate_words
from pipeline.generation.generation_run import (
    MAX_TASKS,
    TASK_S,
    Piece,
    Runner,
    TaskCutter,
    TaskResult,
    children_of_gpu,
)
from pipeline.generation.pipeline import make_dataset, prepare_dataset
from pipeline.presets.registry import DATASET_PRESETS, preset_settings
from pipeline.renders.mitsuba_variant import visible_gpus
from pipeline.shards import pack_shards as pack
from storage.dataset.dataset import open_dataset, open_listed
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import read_manifest
from storage.dataset.progress import missing_shards, read_progress, read_status
from storage.dataset.settings import MOST_SCENES, SplitSettings
from storage.dataset.splits import (
    MOST_SHARDS,
    cut_splits,
    planned_scenes,
    scenes_of_shard,
    shards_for,
)
from storage.dataset.verify import verify_dataset
from storage.errors import EnvironmentFailure, TrilightError
from storage.machine import available_cores
from storage.records.objects import Failure
from storage.records.sample import sample_key
from tests.command_line import trilight
from tests.for_each import case, for_each
from tests.pipeline.generation.bucket_kit import OUT, Killed, Machines, Writes
from tests.pipeline.generation.tiny_scenes_kit import Undocumented, tiny_order, without_rendering

SMOKE = preset_settings("smoke").splits
GIVEN_UP = (1, 6, 7)
"""Of shards of four: in the middle of one, and at the end of one."""


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Counter[int]:
    """Scenes by hand, some of which are given up, with how often each was made."""
    count: Counter[int] = Counter()
    without_rendering(monkeypatch)
    make = pipeline.make_scene

    def some(split: str, scene: int, *more: Any) -> Any:
        count[scene] += 1
        sample, _ = make(split, scene, *more)
        failure = Failure(stage="scenes", item=sample_key(scene), reason="no_camera", message="x")
        return (None if scene in GIVEN_UP else sample), [failure]

    monkeypatch.setattr(pipeline, "make_scene", some)
    return count


def order(root: Path | str, scenes: int, **changes: Any) -> GenerateOptions:
    return tiny_order(out=str(root), scenes=scenes, failure_budget=1.0, **changes)


def make(root: Path | str, scenes: int, **changes: Any) -> str:
    return make_dataset(order(root, scenes, **changes), Undocumented()).digest


def files(root: Path) -> dict[str, bytes]:
    """Return what makes up a dataset."""
    names = ("*.tar", "manifest.json", "failures.jsonl", "objects.lock.jsonl")
    return {path.name: path.read_bytes() for name in names for path in root.glob(name)}


def test_any_growth_ends_as_the_set_made_at_once(tmp_path: Path, made: Counter[int]) -> None:
    rng, sets = np.random.default_rng(7), 0
    walks = [[1, 2, 3, 4, 5], [3, 20], [5, 6, 7, 8], [2, 3, 9, 9, 5]]
    walks += [sorted(map(int, rng.integers(1, 23, rng.integers(2, 6)))) for _ in range(6)]
    for steps in walks:
        with case(steps):
            root, sets = tmp_path / f"grown-{sets}", sets + 1
            made.clear()
            for step in steps:
                make(root, step)
                found = verify_dataset(root)
                assert (found.problems, found.is_finished) == ([], True)
                largest = max(steps[: steps.index(step) + 1])
                status = read_status(str(root))
                counted = status.scenes_done + status.scenes_given_up
                assert found.manifest.num_scenes == counted == largest
            assert made == Counter(range(max(steps))), "no scene is made twice"
            make(tmp_path / f"once-{sets}", max(steps))
            assert files(root) == files(tmp_path / f"once-{sets}")


@contextlib.contextmanager
def killed_at(step: int) -> Iterator[list[int]]:
    """Raise Killed instead of the given file operation, counted over renames, links, deletions."""
    left = [step]

    def counted(call: Any) -> Any:
        def run(*given: Any, **options: Any) -> Any:
            left[0] -= 1
            if left[0] < 0:
                raise Killed
            return call(*given, **options)

        return run

    with pytest.MonkeyPatch.context() as patch:
        for module, name in ((os, "replace"), (os, "link"), (shutil, "rmtree")):
            patch.setattr(module, name, counted(getattr(module, name)))
        yield left


@pytest.mark.usefixtures("made")
def test_growth_that_is_killed_anywhere_is_finished_by_the_next_command(tmp_path: Path) -> None:
    make(tmp_path / "small", 6)
    whole, small = make(tmp_path / "whole", 11), read_manifest(tmp_path / "small/manifest.json")
    for step in range(200):
        root = tmp_path / f"killed-{step}"
        shutil.copytree(tmp_path / "small", root)
        with killed_at(step) as left, contextlib.suppress(Killed):
            make(root, 11)
        with case(step):
            seen = open_dataset(str(root))
            read = [sample for shard in seen.manifest.shards for sample in seen.read_shard(shard)]
            assert len(read) >= small.num_samples, "what was there can be read"
            faults = verify_dataset(root).problems
            assert [text for text in faults if "not in the man" not in text] == []
            assert make(root, 11) == whole
            assert files(root) == files(tmp_path / "whole")
        shutil.rmtree(root)
        if left[0] >= 0:
            break
    assert 20 < step < 199


def test_a_smaller_set_that_is_being_made_learns_of_the_larger_one(
    tmp_path: Path, made: Counter[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another maker plans more while the last scene of the smaller set is made."""
    whole, make_scene = make(tmp_path / "whole", 7), pipeline.make_scene

    def late(split: str, scene: int, *more: Any) -> Any:
        if scene == 4:
            monkeypatch.setattr(pipeline, "make_scene", make_scene)
            prepare_dataset(order(tmp_path / "set", 7))
        return make_scene(split, scene, *more)

    monkeypatch.setattr(pipeline, "make_scene", late)
    assert make(tmp_path / "set", 5) == whole
    assert files(tmp_path / "set") == files(tmp_path / "whole")


def test_a_shard_that_grows_is_missing_and_readable(tmp_path: Path, made: Counter[int]) -> None:
    root, whole = tmp_path / "set", make(tmp_path / "whole", 9)
    make(root, 3)
    (root / "README.md").touch()  # no documents are written here
    assert missing_shards(str(root), 3) == []
    assert missing_shards(str(root), 9) == [0, 1, 2]
    assert make(root, 9, shards="1:3") == ""
    status = read_status(str(root))
    assert (status.shards_done, status.shards_planned) == (2, 3)
    assert status.scenes_done == read_progress(DatasetFolder(root)).scenes_done == 5
    assert status.scenes_given_up == 3
    assert not verify_dataset(root).is_finished
    assert [shard.num_samples for shard in open_dataset(str(root)).manifest.shards] == [2, 2, 1]
    assert missing_shards(str(root)) == [0]
    (root / "train-000000.tar").write_bytes(b"damaged")  # its scenes are made again
    shutil.rmtree(root / ".staging")
    assert make(root, 9, shards="0:1") == whole
    assert verify_dataset(root).problems == []


def test_a_larger_set_that_was_made_while_a_worker_waited_stays_finished(
    tmp_path: Path, made: Counter[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    root, mutex, waits = tmp_path / "set", DatasetFolder.mutex, itertools.count(1)
    make(root, 3)

    def late(folder: DatasetFolder, what: str) -> Any:
        if what == "manifest" and next(waits) == 2:
            monkeypatch.setattr(DatasetFolder, "mutex", mutex)
            make(root, 6)
        return mutex(folder, what)

    monkeypatch.setattr(DatasetFolder, "mutex", late)
    prepare_dataset(order(root, 6, shards="0:1"))
    assert read_manifest(root / "manifest.json").growing == ()
    assert verify_dataset(root).is_finished


def test_who_packs_a_growing_shard_second_without_locks_has_the_first_ones_result(
    tmp_path: Path, made: Counter[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    make(tmp_path / "set", 3)
    whole, first = make(tmp_path / "whole", 4), pack.write_shard

    def late(path: Path, samples: Any) -> None:
        first(path, samples)
        monkeypatch.setattr(pack, "write_shard", first)
        if (tmp_path / "set") in path.parents:
            pack.pack_shard(DatasetFolder(tmp_path / "set"), path.name, range(4), grows=True)

    monkeypatch.setattr(pack, "write_shard", late)
    assert make(tmp_path / "set", 4) == whole
    folder = DatasetFolder(tmp_path / "set")
    vanished = r"train-000001.tar: a file vanished .* run the same command"
    with pytest.raises(TrilightError, match=vanished):
        pack.pack_shard(folder, "train-000001.tar", range(4, 8))


@pytest.mark.usefixtures("made")
def test_a_bucket_grows_whoever_dies_when(
    tmp_path: Path, bucket: Any, machines: Machines, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The n-th write of each run never happens; three machines take turns until one is through."""
    machines.use("plain")
    whole, writes, runs = make(tmp_path / "whole", 11), Writes(monkeypatch), 0
    for scenes in (3, 6, 11):
        for number in range(100):
            writes.left, runs = number // 2, runs + 1
            machines.use("abc"[number % 3])
            with case((scenes, number)), contextlib.suppress(Killed):
                make(OUT, scenes)
                break
            if bucket.exists("shards/set/manifest.json"):
                assert scenes > 3 or verify_dataset(OUT).problems == []
                listed = open_listed(OUT).manifest
                assert len(listed.shards) in (0, shards_for(listed.num_scenes, SMOKE))
        assert open_listed(OUT).manifest.num_scenes == scenes
    assert runs > 30
    assert open_dataset(OUT).digest == whole
    assert verify_dataset(OUT).problems == []
    for name, data in files(tmp_path / "whole").items():
        assert bucket.cat_file(f"shards/set/{name}") == data, name


@pytest.mark.usefixtures("made")
def test_a_bucket_without_notes_grows(tmp_path: Path, bucket: Any, machines: Machines) -> None:
    """A finished set that was copied, grown by two machines to two numbers of scenes."""
    machines.use("plain")
    whole = make(tmp_path / "whole", 7)
    make(tmp_path / "small", 5)
    bucket.put(str(tmp_path / "small"), "shards/set", recursive=True)
    bucket.rm("shards/set/.staging", recursive=True)
    machines.use("a")
    make(OUT, 6)
    machines.use("b")
    assert make(OUT, 7) == whole
    assert verify_dataset(OUT).problems == []


def test_every_preset_makes_one_scene() -> None:
    for name in DATASET_PRESETS:
        splits = preset_settings(name).splits
        assert planned_scenes(1, splits) == shards_for(1, splits) == 1, name
        assert scenes_of_shard(0, cut_splits(1, splits)) == range(1)
        most = min(MOST_SCENES, MOST_SHARDS * splits.scenes_per_shard)
        last = shards_for(most, splits) - 1
        assert scenes_of_shard(last, cut_splits(most, splits)).stop == most


def _scenes(tasks: list[tuple[Piece, ...]]) -> list[int]:
    return [scene for task in tasks for piece in task for scene in range(piece.first, piece.last)]


def _cutter(scenes: int, seconds: float, at_once: int = 1) -> TaskCutter:
    """Return a cutter after one task."""
    cutter = TaskCutter(at_once)
    cutter.record(TaskResult(shards=(), scenes=scenes, seconds=seconds, core_s=seconds))
    return cutter


@given(
    shards=st.lists(st.integers(0, 5000), unique=True, max_size=60).map(sorted),
    per_shard=st.integers(1, 300),
    seconds=st.floats(0.01, 2000),
    most=st.integers(1, 50),
)
def test_every_scene_is_in_one_task(
    shards: list[int], per_shard: int, seconds: float, most: int
) -> None:
    splits = SplitSettings(scenes_per_shard=per_shard)
    cutter = _cutter(1, seconds)
    cutter._tasks_left = most
    tasks = list(cutter.cut_round(shards, splits))
    expected = [scene for shard in shards for scene in scenes_of_shard(shard, splits)]
    assert _scenes(tasks) == expected
    assert len(tasks) <= most
    for task in tasks:
        for piece in task:
            scenes = scenes_of_shard(piece.shard_index, splits)
            assert scenes.start <= piece.first < piece.last <= scenes.stop


def test_a_task_takes_the_time_that_is_measured_and_a_run_at_most_a_thousand_tasks() -> None:
    """At 10 s a scene 24 of them: half a shard of 48, or six of 4."""
    cutter = _cutter(3, 30.0)
    for per_shard, pieces in ((48, 1), (4, 6)):
        tasks = list(cutter.cut_round(range(24), SplitSettings(scenes_per_shard=per_shard)))
        assert len(_scenes(tasks[:1])) == TASK_S / 10
        assert len(tasks[0]) == pieces
    # Sizes follow what is measured on the way.
    cutter = TaskCutter()
    cut = cutter.cut_round(range(100), SplitSettings(scenes_per_shard=4))
    assert len(_scenes([next(cut)])) == 4
    cutter.record(TaskResult(shards=(), scenes=4, seconds=4.0, core_s=4.0))
    assert len(_scenes([next(cut)])) == TASK_S
    # All rounds of a run are at most a thousand tasks.
    splits, cutter, rounds = SplitSettings(scenes_per_shard=1), TaskCutter(), list[int]()
    with pytest.raises(EnvironmentFailure, match="run the same command again"):
        while True:
            rounds.append(sum(1 for _ in cutter.cut_round(range(5000), splits)))
    assert rounds[:2] == [900, 90]
    assert sum(rounds) == MAX_TASKS


@for_each("at_once", [2, 8])
def test_several_at_once_all_have_work_until_the_end(at_once: int) -> None:
    """Fast scenes, of which one task could take all: nobody gets more than half of a share."""
    left = 256
    for task in _cutter(4, 1.0, at_once).cut_round(range(64), SplitSettings(scenes_per_shard=4)):
        size = len(_scenes([task]))
        assert size <= max(1, left / (2 * at_once))
        left -= size
    assert left == 0


def test_wrong_orders_are_named() -> None:
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"build": "nonsense"}, "preset 'nonsense'"),
        ({"scenes": 0}, "scenes is 0"),
        ({"failure_budget": 1.5}, "failure_budget is 1.5"),
        ({"shards": "4:4"}, "shards is '4:4'"),
        ({"views": 2}, "--views is 2"),
        ({"scenes_from": "a", "scenes": 3}, "given with --scenes; expected it without"),
    ]
    for changes, message in wrong:
        with case(changes), pytest.raises(TrilightError, match=message):
            GenerateOptions(**changes)
    assert GenerateOptions(shards="4:7").shard_range() == range(4, 7)


ASKED = GenerateOptions(
    build="pretrain-256",
    objects="my objects",
    scenes=2_000_000,
    seed=7,
    resolution=64,
    noise_floor_db=25.5,
    noise_floor_linear_db=20.5,
    noise_floor_objects_db=24.5,
    allow_licences=("CC-BY-NC-4.0", "MIT"),
    licence="CC0-1.0",
    failure_budget=0.2,
    accept_environment=True,
    changes={
        "storage.profile": "lossless",
        "renders.per_light": True,
        "scenes.lights.count": [1, 3],
    },
)


def test_words_are_every_option_that_was_given_and_no_more() -> None:
    words = generate_words(ASKED)
    assert words[:4] == ["generate", "pretrain-256", "--objects", "my objects"]
    assert set(pairwise(words)) >= {
        ("--scenes", "2000000"),
        ("--seed", "7"),
        ("--resolution", "64"),
        ("--noise-floor", "25.5"),
        ("--noise-floor-linear", "20.5"),
        ("--noise-floor-objects", "24.5"),
        ("--allow-licence", "CC-BY-NC-4.0"),
        ("--allow-licence", "MIT"),
        ("--licence", "CC0-1.0"),
        ("--failure-budget", "0.2"),
    }
    assert "--accept-environment" in words
    stated = [words[i + 1] for i, word in enumerate(words) if word == "--set"]
    assert parse_overrides(stated) == json.loads(json.dumps(dict(ASKED.changes)))
    shown = trilight(["generate", "--help-all"], env={"COLUMNS": "200"}).output
    assert all(word in shown for word in words if word.startswith("--"))
    plain = generate_words(GenerateOptions(workers=3, shards="0:2", out="x"))
    assert plain == ["generate", "smoke"]
    changes = {"source": "12", "storage.profile": "true"}  # words that are JSON stay words
    assert parse_overrides(generate_words(GenerateOptions(changes=changes))[3::2]) == changes
    with_password = GenerateOptions(objects="https://me:secret@host/objects?key=1")
    assert generate_words(with_password)[3] == "https://host/objects"


def test_a_place_that_is_free_is_taken_before_the_result_is_looked_at() -> None:
    submitted: list[Any] = []

    class Inline(Runner[Any]):
        window = 2

        def submit(self, task: Any, job: Any) -> Any:
            submitted.append(task)
            return SimpleNamespace(result=lambda: task)

        def wait_any(self, running: list[Any]) -> Any:
            return running[0]

    results: Any = Inline().run(cast(Any, range(5)), cast(Any, None))
    assert next(results) == 0
    assert submitted == [0, 1, 2]
    assert list(results) == [1, 2, 3, 4]
    assert submitted == [0, 1, 2, 3, 4]


def test_cores_and_gpus_are_those_of_this_process_unless_said(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A GPU has as many children as keep it busy and fit."""
    monkeypatch.delenv("TRILIGHT_CORES", raising=False)
    before = os.sched_getaffinity(0)
    assert 1 <= available_cores() <= len(before)
    try:
        os.sched_setaffinity(0, {min(before)})
        assert available_cores() == 1
    finally:
        os.sched_setaffinity(0, before)
    monkeypatch.setenv("TRILIGHT_CORES", "3")
    assert available_cores() == 3
    monkeypatch.setenv("TRILIGHT_CORES", "many")
    with pytest.raises(TrilightError, match="TRILIGHT_CORES is 'many'"):
        available_cores()
    for value, gpus in (("0,2", ("0", "2")), ("GPU-1a", ("GPU-1a",)), ("", ()), ("-1", ())):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", value)
        assert visible_gpus() == gpus, value
    rows = [(256, 80, 4), (512, 8, 4), (512, 4, 2), (2048, 24, 2), (2048, 141, 4), (256, 0, 1)]
    for resolution, memory_gib, children in rows:
        assert children_of_gpu(resolution, memory_gib << 30) == children, (resolution, memory_gib)
