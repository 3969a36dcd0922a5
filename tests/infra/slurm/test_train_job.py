"""The job file of training under a fake Slurm: what nodes start, and when a job is queued again."""

import json
import os
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.conftest import ROOT
from tests.infra.slurm.fake_slurm import commands_in

SCRIPT = ROOT / "infra" / "slurm" / "train.sbatch"

PYTHON = """#!/bin/bash
# in place of Python: works until it is asked to stop, or does what $BEHAVES says
trap 'exit 1' USR1 TERM
said=$FAKE_SLURM/node-$SLURM_NODEID
{ printf '%s\\n' "$SLURM_NODEID" "$OMP_NUM_THREADS" "$@"; echo; } >> "$said"
[ "$BEHAVES" != fails ] || exit 1
mkdir -p "$OUT/checkpoints"
count=$(ls "$OUT/checkpoints" | wc -l)
[ "$SLURM_NODEID" != 0 ] || [ "$BEHAVES" = idles ] ||
    touch "$OUT/checkpoints/step-00000000$count.safetensors"
[ "$count" -lt 1 ] || exit 0  # the second call ends the run
while [ $((turns += 1)) -lt 3000 ]; do sleep 0.02; done  # a minute, whatever becomes of the test
exit 3
"""


class Job(NamedTuple):
    """A job that was submitted."""

    place: Path
    """Folder of the fake Slurm."""
    process: "subprocess.Popen[str]"

    def when(self, name: str, file: str) -> None:
        """Make a file of the fake Slurm once another one is there."""
        while not (self.place / file).exists():
            assert self.process.poll() is None, self.process.communicate()
            time.sleep(0.01)
        (self.place / name).touch()

    def calls(self) -> list[list[str]]:
        return [json.loads(line) for line in (self.place / "calls").read_text().splitlines()]

    def starts(self, node: int) -> list[list[str]]:
        """Return the words with which each start of a node called Python, after its own facts."""
        blocks = (self.place / f"node-{node}").read_text().split("\n\n")
        return [block.split("\n") for block in blocks if block]


Submit = Callable[..., Job]
"""Takes the words for sbatch, what each node does, and variables."""


@pytest.fixture
def submit(tmp_path: Path) -> Submit:
    def submitted(*words: str, behaves: str = "works", **variables: str) -> Job:
        place = tmp_path / "slurm"
        place.mkdir()
        python = tmp_path / "python"
        python.write_text(PYTHON)
        python.chmod(0o755)
        environment = {
            "PATH": f"{commands_in(place)}:{os.environ['PATH']}", "FAKE_SLURM": str(place),
            "PYTHON": str(python), "BEHAVES": behaves, **variables,
        }  # fmt: skip
        return Job(
            place,
            subprocess.Popen(
                ["sbatch", "--nodes=2", *words],
                executable=place / "sbatch",
                cwd=tmp_path,
                env=environment,
                stderr=subprocess.PIPE,
                text=True,
            ),
        )

    return submitted


def test_each_node_starts_torchrun_and_a_job_whose_time_is_up_goes_on(submit: Submit) -> None:
    job = submit(str(SCRIPT), "pretrain", "--data", "a b")
    job.when("time-is-up", "../runs/pretrain/checkpoints/step-000000000.safetensors")
    assert job.process.wait(timeout=60) == 0, "the second start ends the run"
    (step, *_) = [words for words in job.calls() if words[0] == "srun"]
    assert "--cpus-per-task=64" in step
    for node in (0, 1):
        first, second = job.starts(node)
        assert first == second, "the same command goes on"
        assert first[:2] == [str(node), "1"]
        launch, run = first[2 : first.index("trilight")], first[first.index("trilight") :]
        assert launch[:4] == ["-m", "torch.distributed.run", "--nnodes=2", "--nproc-per-node=8"]
        assert {"--rdzv-endpoint=localhost:24711", f"--rdzv-conf=is_host={1 - node}"} < set(launch)
        assert "--shutdown-timeout=240" in launch
        assert any("SIGUSR1" in word for word in launch if word.startswith("--signals-to-handle"))
        rest = ["--out", "runs/pretrain", "--restartable", "--workers", "7"]
        assert run == ["trilight", "train", "pretrain", "--data", "a b", *rest]


def test_what_is_said_otherwise_holds(submit: Submit) -> None:
    job = submit("--cpus-per-task=6", "--gpus-per-node=2", str(SCRIPT), "mine.py:mine",
                 "--workers", "5", behaves="fails", OUT="elsewhere", RESTARTS="0")  # fmt: skip
    assert job.process.wait(timeout=60) == 1
    ((_, _, *words),) = job.starts(0)
    assert {"--nproc-per-node=2", "--max-restarts=0"} < set(words)
    run = ["mine.py:mine", "--workers", "5", "--out", "elsewhere", "--restartable"]
    assert words[-len(run) :] == run
    assert not any(words[:2] == ["scontrol", "requeue"] for words in job.calls())


@pytest.mark.parametrize("name", ["cancel", "time-is-up"])
def test_a_job_that_was_cancelled_or_saved_nothing_is_not_queued_again(
    submit: Submit, name: str
) -> None:
    behaves = "works" if name == "cancel" else "idles"
    job = submit(str(SCRIPT), "smoke", behaves=behaves)
    saved = "/step-000000000.safetensors" if name == "cancel" else ""
    job.when(name, f"../runs/smoke/checkpoints{saved}")
    assert job.process.wait(timeout=60) != 0
    assert not any(words[:2] == ["scontrol", "requeue"] for words in job.calls())


def test_python_that_is_not_there_is_named(submit: Submit) -> None:
    job = submit(str(SCRIPT), "smoke", PYTHON="/nowhere/python")
    assert job.process.wait(timeout=60) == 2
    assert job.process.stderr is not None
    assert "PYTHON=/nowhere/python: no such program" in job.process.stderr.read()
