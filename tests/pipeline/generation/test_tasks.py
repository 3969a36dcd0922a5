"""How work is ordered and cut: words of an order, every scene once, sizes by measurement."""

import dataclasses
import json
import os
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from infra.cli.overrides import parse_overrides
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
from pipeline.renders.mitsuba_variant import visible_gpus
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import scenes_of_shard
from storage.errors import EnvironmentFailure, TrilightError
from storage.machine import available_cores
from tests.command_line import trilight
from tests.for_each import for_each


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
    tasks = list(_cutter(1, seconds).iter_tasks(shards, splits, most=most))
    expected = [scene for shard in shards for scene in scenes_of_shard(shard, splits)]
    assert _scenes(tasks) == expected
    assert len(tasks) <= most
    for task in tasks:
        for piece in task:
            scenes = scenes_of_shard(piece.shard_index, splits)
            assert scenes.start <= piece.first < piece.last <= scenes.stop


def test_a_task_takes_the_time_that_it_should() -> None:
    """At 10 s a scene 24 of them: half a shard of 48, or six of 4."""
    cutter = _cutter(3, 30.0)
    for per_shard, pieces in ((48, 1), (4, 6)):
        tasks = list(cutter.iter_tasks(range(24), SplitSettings(scenes_per_shard=per_shard)))
        assert len(_scenes(tasks[:1])) == TASK_S / 10
        assert len(tasks[0]) == pieces


def test_sizes_follow_what_is_measured_on_the_way() -> None:
    cutter = TaskCutter()
    tasks = cutter.iter_tasks(range(100), SplitSettings(scenes_per_shard=4))
    assert len(_scenes([next(tasks)])) == 4
    next(tasks)  # was cut when the first was handed out
    cutter.record(TaskResult(shards=(), scenes=4, seconds=4.0, core_s=4.0))
    assert len(_scenes([next(tasks)])) == TASK_S


@for_each("at_once", [2, 8])
def test_several_at_once_all_have_work_until_the_end(at_once: int) -> None:
    """Fast scenes, of which one task could take all: nobody gets more than half of a share."""
    left = 256
    for task in _cutter(4, 1.0, at_once).iter_tasks(range(64), SplitSettings(scenes_per_shard=4)):
        size = len(_scenes([task]))
        assert size <= max(1, left / (2 * at_once))
        left -= size
    assert left == 0


def test_all_rounds_of_a_run_are_at_most_a_thousand_tasks() -> None:
    splits, cutter, rounds = SplitSettings(scenes_per_shard=1), TaskCutter(), list[int]()
    with pytest.raises(EnvironmentFailure, match="run the same command again"):
        while True:
            rounds.append(sum(1 for _ in cutter.cut_round(range(5000), splits)))
    assert rounds[:2] == [900, 90]
    assert sum(rounds) == MAX_TASKS


@for_each(
    ("changes", "message"),
    [
        ({"build": "nonsense"}, "preset 'nonsense'"),
        ({"scenes": 0}, "scenes is 0"),
        ({"failure_budget": 1.5}, "failure_budget is 1.5"),
        ({"shards": "4:4"}, "shards is '4:4'"),
        ({"views": 2}, "--views is 2"),
        ({"scenes_from": "a", "scenes": 3}, "expected neither"),
    ],
)
def test_wrong_orders_are_named(changes: dict[str, object], message: str) -> None:
    with pytest.raises(TrilightError, match=message):
        dataclasses.replace(GenerateOptions(), **changes)  # type: ignore[arg-type]
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


def test_every_option_that_was_given_is_there() -> None:
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
    changes = [words[i + 1] for i, word in enumerate(words) if word == "--set"]
    assert parse_overrides(changes) == json.loads(json.dumps(dict(ASKED.changes)))
    shown = trilight(["generate", "--help-all"], env={"COLUMNS": "200"}).output
    assert all(word in shown for word in words if word.startswith("--"))


def test_words_are_what_was_asked_for_and_no_more() -> None:
    assert generate_words(GenerateOptions(workers=3, shards="0:2", out="x")) == [
        "generate",
        "smoke",
    ]
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


def test_cores_are_those_of_the_affinity_unless_said(monkeypatch: pytest.MonkeyPatch) -> None:
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


@for_each(
    ("value", "cards"),
    [("0,2", ("0", "2")), ("GPU-1a", ("GPU-1a",)), ("", ()), ("-1", ())],
)
def test_cards_are_those_that_are_visible(
    monkeypatch: pytest.MonkeyPatch, value: str, cards: tuple[str, ...]
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", value)
    assert visible_gpus() == cards


@for_each(
    ("resolution", "memory_gib", "children"),
    [(256, 80, 4), (512, 8, 4), (512, 4, 2), (2048, 24, 2), (2048, 141, 4), (256, 0, 1)],
)
def test_a_card_has_as_many_children_as_keep_it_busy_and_fit(
    resolution: int, memory_gib: int, children: int
) -> None:
    assert children_of_gpu(resolution, memory_gib << 30) == children
