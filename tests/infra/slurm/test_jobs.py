"""Jobs of clusters: files, printed commands, flows that are watched, and a fake Slurm."""

import contextlib
import json
import os
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest import mock
from uuid import UUID

import pytest
from prefect.states import Completed, Crashed, Pending, Running, State

from pipeline.executors import slurm_and_kubernetes as arrays
from pipeline.flows import submission
from tests.command_line import expect_json, trilight
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


FAKE = """#!/bin/bash
for word in "$@"; do
    case $word in */*.yaml) test -s "$word" || exit 3 ;; esac
done
printf '%s\\n' "$(basename "$0") $*" >> "$FAKE_ASKED"
if [ -n "$FAKE_REFUSES" ]; then echo "AlreadyExists" >&2; exit 1; fi
"""


def test_the_printed_commands_do_what_submitting_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a tool that writes down what it is asked, and a bucket without a dataset."""
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "kubectl").write_text(FAKE)
    (tmp_path / "bin" / "kubectl").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    asked = tmp_path / "asked"
    monkeypatch.setenv("FAKE_ASKED", str(asked))
    monkeypatch.setattr(arrays, "_is_begun", lambda place: False)
    monkeypatch.setenv("TRILIGHT_IMAGE", "registry.example/trilight:1")
    monkeypatch.chdir(tmp_path)
    words = ["submit", "kubernetes", "smoke", "--out", "s3://sets/mine", "--files", "my jobs"]
    said = expect_json(*words, "--dry-run")
    assert said["array"] == "0-5" and not said["submitted"] and not asked.exists()
    assert all((tmp_path / file).is_file() for file in said["files"])
    printed = trilight([*words, "--dry-run"]).stdout.splitlines()
    commands = [line for line in printed if line.startswith("kubectl ")]
    assert len(commands) == len(said["commands"])
    subprocess.run(["bash", "-ec", "\n".join(commands)], check=True)
    by_hand = asked.read_text()
    asked.unlink()
    done = trilight(words)
    assert done.exit_code == 0 and "trilight status s3://sets/mine" in done.stdout
    assert asked.read_text() == by_hand
    monkeypatch.setenv("FAKE_REFUSES", "1")
    assert "kubectl refused (AlreadyExists)" in trilight(words).mistake
    monkeypatch.setenv("PATH", "/nowhere")
    assert "no kubectl here; expected it installed and logged in" in trilight(words).mistake
    assert "'--sbatch' is unknown" in trilight([*words, "--sbatch=-x"]).mistake


def test_status_prints_what_any_scheduler_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("infra.cli.status.missing_shards", lambda dataset: [0, 1, 5, 8])
    words = ["status", "set", "--missing", "--shards-per-task", "2"]
    assert trilight(words).stdout == "0,2,4\n"
    assert trilight([*words, "--lines"]).stdout == "0:2\n4:6\n8:10\n"
    assert json.loads(trilight([*words, "--json"]).stdout) == {
        "missing": [0, 2, 4], "array": "0,2,4", "shards": ["0:2", "4:6", "8:10"],
        "shards_per_task": 2,
    }  # fmt: skip


RUN = SimpleNamespace(id=UUID(int=1), name="a-run")


def seen(state: State, **tables: dict[str, str]) -> tuple[State, float, dict[str, dict[str, str]]]:
    return state, 50.0, tables


def test_a_run_is_watched_to_its_end_or_given_and_one_that_crashed_is_a_mistake(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked = mock.Mock(return_value=RUN)  # for a run of the deployment that has its flow's name
    client = SimpleNamespace(create_flow_run_from_deployment=asked)

    def find(client: Any, flow: str, name: str | None) -> SimpleNamespace:
        return SimpleNamespace(id=flow, name=name or "local", work_pool_name="local")

    monkeypatch.setattr(submission, "server", lambda: contextlib.nullcontext(client))
    monkeypatch.setattr(submission, "find_deployment", find)
    monkeypatch.setattr(submission, "page_of", lambda client, run: "http://page")
    monkeypatch.setattr(submission, "workers_online", lambda client, pool: 1)
    looks = [seen(Pending()), seen(Running()), seen(Running())]
    looks.append(seen(Completed(), summary={"scenes": "2"}))
    monkeypatch.setattr(submission, "poll_run", lambda client, run: iter(looks))
    words = ["submit", "generate-scenes", "smoke", "--scenes", "2", "--out", str(tmp_path)]
    told = trilight(words).stdout
    given = {"build": "smoke", "scenes": 2, "out": str(tmp_path)}
    asked.assert_called_once_with("generate-scenes", parameters=given)
    for line in ("Run a-run of generate-scenes/local: http://page", "Pending", "scenes  2"):
        assert told.count(line) == 1, told
    assert f"Next: trilight verify {tmp_path}" in told
    assert json.loads(trilight([*words, "--json"]).stdout)["summary"] == {"scenes": "2"}
    ended = seen(Crashed(message="it was killed."))
    monkeypatch.setattr(submission, "poll_run", lambda client, run: iter([ended]))
    failed = trilight(words)
    assert "ended as Crashed: it was killed. Its log is at http://page" in failed.stderr
    asked.reset_mock()
    words = ["submit", "generate-scenes", "smoke", "--no-watch", "--deployment", "cluster"]
    assert json.loads(trilight([*words, "--json"]).stdout) == {
        "flow_run": str(RUN.id), "deployment": "generate-scenes/cluster",
    }  # fmt: skip
    assert asked.call_count == 1
