"""`trilight submit slurm` and `status --missing`: only what is missing, as arrays that fit."""

import contextlib
import json
import os
import shlex
import subprocess
from pathlib import Path

import pytest

from pipeline.executors.array_job import MOST_TASKS, ArrayJob, array_job
from pipeline.executors.registry import find_executor
from pipeline.executors.slurm_array import sbatch_environment, sbatch_words
from pipeline.making.dataset_order import DatasetOrder
from storage.dataset.progress import missing_shards
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from storage.number_ranges import number_ranges
from tests.command_line import trilight
from tests.for_each import for_each
from tests.pipeline.making.tiny_scenes_kit import Undocumented, tiny_order, without_rendering

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


def test_an_array_fits_the_cluster_and_covers_every_shard(cluster: Path) -> None:
    order = DatasetOrder(build="pretrain-256", scenes=2_000_000)
    job = array_job(order, per_task=None, at_once=None)
    shards = -(-2_000_000 // 256)
    assert len(job.tasks) <= MOST_TASKS
    assert job.per_task * len(job.tasks) >= shards > job.per_task * (len(job.tasks) - 1)
    with pytest.raises(TrilightError, match="shards-per-task is 1: .* task 7812; .* 8 shards"):
        array_job(order, per_task=1, at_once=None)


def test_settings_that_divide_the_dataset_count(cluster: Path) -> None:
    changes = {"splits.scenes_per_shard": 8}
    order = DatasetOrder(build="smoke", scenes=64, changes=changes, objects="my objects")
    job = array_job(order, per_task=2, at_once=3)
    assert job.tasks == [0, 1, 2, 3]
    words = sbatch_words(job)
    assert words[:3] == ["sbatch", "--parsable", "--array=0-3%3"]
    assert words[4:] == ["--changes", "splits.scenes_per_shard=8"]
    given = sbatch_environment(job)
    assert given["OBJECTS"] == "my objects" and given["SCENES"] == "64"
    for refused in (DatasetOrder(shards="0:1"), DatasetOrder(scenes_from="folder")):
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
    monkeypatch.setattr("pipeline.executors.slurm.ThreadRunner", Undocumented)
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
    order = DatasetOrder(build="smoke", objects="http://ada:secret@host/objects/")
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
    assert "are those of submit slurm" in str(result.exception)
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
