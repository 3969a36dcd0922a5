"""Executors are peers; arrays of Slurm by its variables, and `submit slurm` of what is missing."""

import contextlib
import dataclasses
import json
import os
import shlex
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest

from pipeline.executors.array_job import MAX_TASKS, ArrayJob, array_job
from pipeline.executors.registry import EXECUTORS, find_executor
from pipeline.executors.slurm import shards_of_task
from pipeline.executors.slurm_array import sbatch_command, sbatch_environment
from pipeline.generation.generate_options import GenerateOptions
from storage.dataset.dataset import open_dataset
from storage.dataset.progress import missing_shards
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from storage.number_ranges import number_ranges, numbers_of
from tests.command_line import trilight
from tests.conftest import ROOT
from tests.for_each import for_each
from tests.pipeline.generation.tiny_scenes_kit import Undocumented, tiny_order, without_rendering


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
    shares = [shards_of_task(_array(k, 0, 4, 5), _shards(2)) for k in range(5)]
    assert shares == ["0:1", "1:2", "0:1", "1:2", "0:1"], "more tasks than shards"

    def unknown() -> int:
        raise AssertionError("nobody needs to know: the dataset need not even be begun")

    alone = {"SLURM_ARRAY_TASK_ID": "2", "SHARDS_PER_TASK": "4"}
    assert shards_of_task(alone, unknown) == "8:12"


@for_each(
    ("environment", "message"),
    [
        ({}, "SLURM_ARRAY_TASK_ID is not set; expected a task of an array, .* Submit"),
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
    monkeypatch.setattr("pipeline.executors.threads.ThreadRunner", lambda: finished)
    alone, shared = (tiny_order(out=str(tmp_path / name), scenes=12) for name in ("one", "set"))
    find_executor("threads", None, None).make(alone, None)
    finished.finished = 0
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


FAKE = """#!/bin/bash
printf '%s\\n' "$@" > "$FAKE_SBATCH"
env > "$FAKE_SBATCH.env"
if [ -n "$FAKE_REFUSES" ]; then echo "sbatch: error: invalid partition" >&2; exit 1; fi
echo "4711;cluster"
"""


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with an sbatch that writes down what it is asked, and is the current one."""
    program = tmp_path / "bin" / "sbatch"
    program.parent.mkdir()
    program.write_text(FAKE)
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    monkeypatch.setenv("FAKE_SBATCH", str(tmp_path / "asked"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@for_each(
    ("numbers", "text"),
    [((), ""), ((4,), "4"), ((3, 2, 1, 0, 7, 7), "0-3,7"), ((0, 2, 3), "0,2-3")],
)
def test_ranges(numbers: tuple[int, ...], text: str) -> None:
    assert number_ranges(numbers) == text
    assert numbers_of(text) == sorted(set(numbers))


def test_an_array_fits_the_cluster_and_covers_every_shard(cluster: Path) -> None:
    order = GenerateOptions(build="pretrain-256", scenes=2_000_000)
    job = array_job(order, per_task=None, at_once=None)
    shards = -(-2_000_000 // 256)
    assert len(job.tasks) <= MAX_TASKS
    assert job.per_task * len(job.tasks) >= shards > job.per_task * (len(job.tasks) - 1)
    with pytest.raises(TrilightError, match="shards-per-task is 1: .* task 7812; .* 8 shards"):
        array_job(order, per_task=1, at_once=None)


def test_settings_that_divide_the_dataset_count(cluster: Path) -> None:
    changes = {"splits.scenes_per_shard": 8}
    order = GenerateOptions(build="smoke", scenes=64, changes=changes, objects="my objects")
    job = array_job(order, per_task=2, at_once=3)
    assert job.tasks == [0, 1, 2, 3]
    words = sbatch_command(job)
    assert words[:3] == ["sbatch", "--parsable", "--array=0-3%3"]
    assert words[4:] == ["--set", "splits.scenes_per_shard=8"]
    given = sbatch_environment(job)
    assert given["OBJECTS"] == "my objects" and given["SCENES"] == "64"
    for refused in (GenerateOptions(shards="0:1"), GenerateOptions(scenes_from="folder")):
        with pytest.raises(TrilightError, match="submit slurm: expected no"):
            array_job(refused, per_task=None, at_once=None)


def test_only_what_is_missing_is_submitted(cluster: Path) -> None:
    words = ["submit", "slurm", "smoke", "--out", "set", "--scenes", "24", "--sbatch=--partition=a"]
    first = trilight([*words, "--json"])
    assert first.exit_code == 0, first.exception
    assert json.loads(first.stdout) == {"job": "4711", "array": "0-5", "shards_per_task": 1}
    asked = (cluster / "asked").read_text().split("\n")
    assert asked[:3] == ["--parsable", "--array=0-5", "--partition=a"]
    assert Path(asked[3]).name == "generate.sbatch" and (cluster / "logs").is_dir()
    assert "SHARDS_PER_TASK=1" in (cluster / "asked.env").read_text().splitlines()


def test_tasks_that_died_are_all_that_is_submitted_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two shards a task; the second task dies, and the array that follows is it alone."""

    def killed(scene: int) -> None:
        if scene == 9 and not survives:
            raise KeyboardInterrupt

    survives = False
    without_rendering(monkeypatch, killed)
    monkeypatch.setattr("pipeline.executors.threads.ThreadRunner", Undocumented)
    order = tiny_order(out=str(tmp_path / "set"), scenes=20)

    def run(job: ArrayJob) -> None:
        monkeypatch.setenv("SHARDS_PER_TASK", str(job.per_task))
        for task in job.tasks:
            monkeypatch.setenv("SLURM_ARRAY_TASK_ID", str(task))
            with contextlib.suppress(KeyboardInterrupt):
                find_executor("slurm", None, None).make(order, None)

    first = array_job(order, per_task=2, at_once=None)
    assert first.tasks == [0, 1, 2]
    run(first)
    left = missing_shards(order.place)
    assert left and set(left) <= {2, 3}
    said = trilight(["status", order.place, "--missing", "--shards-per-task", "2"])
    assert said.stdout.strip() == "1"
    survives = True
    again = array_job(order, per_task=2, at_once=None)
    assert again.tasks == [1]
    run(again)
    assert verify_dataset(order.place).problems == []
    # what is left are the documents, which these tasks do not write
    assert missing_shards(order.place) == [0]
    (tmp_path / "set" / "README.md").write_text("# A set")
    assert array_job(order, per_task=2, at_once=None).tasks == []
    assert trilight(["status", order.place, "--missing"]).stdout == ""


def test_passwords_do_not_reach_the_queue() -> None:
    order = GenerateOptions(build="smoke", objects="http://ada:secret@host/objects/")
    with pytest.raises(TrilightError, match="holds a password") as refused:
        array_job(order, per_task=None, at_once=None)
    assert "secret" not in str(refused.value)


def test_refusals(cluster: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAKE_REFUSES", "1")
    words = ["submit", "slurm", "smoke", "--out", "set"]
    result = trilight(words)
    assert "sbatch refused (sbatch: error: invalid partition)" in str(result.exception)
    monkeypatch.setenv("PATH", "/nowhere")
    assert "no sbatch here" in str(trilight(words).exception)
    dry = trilight([*words, "--dry-run"])
    assert dry.exit_code == 0 and "sbatch --parsable --array=0-5" in dry.stdout
    result = trilight(["submit", "generate-scenes", "smoke", "--dry-run"])
    assert result.exit_code == 2 and "'--dry-run' is unknown" in result.mistake
    alone = trilight(["status", "set", "--shards-per-task", "4"])
    assert "expected it only with --missing" in str(alone.exception)
    assert shlex.split(dry.stdout.splitlines()[-1])[4] == "OUT=set"


def test_the_printed_command_does_what_submitting_does(cluster: Path) -> None:
    words = ["submit", "slurm", "smoke", "--out", "my set", "--objects", "my objects"]
    dry = trilight([*words, "--dry-run"])
    assert dry.exit_code == 0 and not (cluster / "logs").exists()
    subprocess.run(["bash", "-c", dry.stdout.splitlines()[-1]], check=True, capture_output=True)
    assert (cluster / "logs").is_dir()
    printed = (cluster / "asked").read_text()
    assert {"OUT=my set", "OBJECTS=my objects"} <= set(
        (cluster / "asked.env").read_text().splitlines()
    )
    assert trilight(words).exit_code == 0
    assert (cluster / "asked").read_text() == printed


def test_what_an_executor_is_and_has_no_use_for() -> None:
    with pytest.raises(TrilightError, match="--workers is 2; expected none with --runner dask"):
        find_executor("dask", "tcp://127.0.0.1:1", 2)
    with pytest.raises(TrilightError, match="--address is tcp://a:1; expected .* --runner dask"):
        find_executor("slurm", "tcp://a:1", None)
    with pytest.raises(TrilightError, match="--runner is 'thread'; .*threads"):
        find_executor("thread", None, None)
    homes = (
        *("executors.threads", "executors.slurm", "executors.kubernetes"),
        *("flows.on_prefect", "flows.on_dask"),
    )
    assert set(EXECUTORS) == {"threads", "slurm", "kubernetes", "prefect", "dask"}
    for home in homes:
        make = import_module(f"pipeline.{home}").make
        assert make.__code__.co_varnames[: make.__code__.co_argcount] == ("options", "address")


def test_names_of_executors_load_neither_prefect_nor_the_stages() -> None:
    """They are asked for at every press of the tab key."""
    code = (
        "import sys, pipeline.executors.registry;"
        "print([name for name in ('prefect', 'distributed', 'pipeline.generation.pipeline') "
        "if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout == "[]\n"
