"""`trilight submit`: an array by printed commands, a flow that is watched, and refusals."""

import contextlib
import json
import os
import subprocess
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest

from pipeline.executors import array_job as arrays
from pipeline.flows import submission
from pipeline.flows.submission import SeenRun, Submitted
from tests.command_line import trilight

FAKE = """#!/bin/bash
for word in "$@"; do
    case $word in */*.yaml) test -s "$word" || exit 3 ;; esac
done
printf '%s\\n' "$(basename "$0") $*" >> "$FAKE_ASKED"
if [ -n "$FAKE_REFUSES" ]; then echo "AlreadyExists" >&2; exit 1; fi
"""


@pytest.fixture
def tools(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a tool that writes down what it is asked, and a bucket without a dataset."""
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "kubectl").write_text(FAKE)
    (tmp_path / "bin" / "kubectl").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    monkeypatch.setenv("FAKE_ASKED", str(tmp_path / "asked"))
    monkeypatch.setattr(arrays, "_is_begun", lambda place: False)
    monkeypatch.setenv("TRILIGHT_IMAGE", "registry.example/trilight:1")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_printed_commands_do_what_submitting_does(tools: Path) -> None:
    words = ["submit", "kubernetes", "smoke", "--out", "s3://sets/mine", "--files", "my jobs"]
    dry = trilight([*words, "--dry-run", "--json"])
    assert dry.exit_code == 0, dry.output
    said = json.loads(dry.stdout)
    assert said["array"] == "0-5" and not said["submitted"] and not (tools / "asked").exists()
    assert all((tools / file).is_file() for file in said["files"])
    printed = trilight([*words, "--dry-run"]).stdout.splitlines()
    commands = [line for line in printed if line.startswith("kubectl ")]
    assert len(commands) == len(said["commands"])
    subprocess.run(["bash", "-ec", "\n".join(commands)], check=True)
    asked = (tools / "asked").read_text()
    (tools / "asked").unlink()
    done = trilight(words)
    assert done.exit_code == 0 and "trilight status s3://sets/mine" in done.stdout
    assert (tools / "asked").read_text() == asked


def test_refusals(tools: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["submit", "kubernetes", "smoke", "--out", "s3://sets/mine"]
    monkeypatch.setenv("FAKE_REFUSES", "1")
    assert "kubectl refused (AlreadyExists)" in trilight(words).mistake
    monkeypatch.setenv("PATH", "/nowhere")
    assert "no kubectl here" in trilight(words).mistake
    assert "--sbatch is an option of submit slurm" in trilight([*words, "--sbatch=-x"]).mistake
    slurm = trilight(["submit", "slurm", "smoke", "--image", "x"])
    assert "leave them out, and use --sbatch" in slurm.mistake
    flow = trilight(["submit", "generate-scenes", "smoke", "--where", "x"])
    assert "options of machines are those of submit slurm, kubernetes" in flow.mistake


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
    assert "--lines is given; expected it only" in trilight(["status", "set", "--lines"]).mistake


RUN = Submitted(
    id=UUID(int=1),
    name="a-run",
    deployment="generate-scenes/local",
    pool="local",
    page="http://page",
)


def seen(state: str, **more: Any) -> SeenRun:
    plain: dict[str, Any] = {"message": "", "percent": 50.0, "tables": {}}
    ended = state in ("Completed", "Crashed")
    told = {**plain, "is_final": ended, "is_completed": state == "Completed", **more}
    return SeenRun(state=state, **told)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What the server is asked for; its run is seen in `looks`, without any by default."""
    found: list[Any] = []

    def submit(client: object, flow: str, deployment: str | None, given: object) -> Submitted:
        found.append((flow, deployment, given))
        return RUN

    monkeypatch.setattr(submission, "server", contextlib.nullcontext)
    monkeypatch.setattr(submission, "submit", submit)
    monkeypatch.setattr(submission, "workers_online", lambda client, pool: 1)
    return found


def test_a_run_is_watched_to_its_end(
    asked: list[Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    looks = [seen("Pending"), seen("Running"), seen("Running")]
    looks.append(seen("Completed", tables={"summary": [("scenes", "2")]}))
    monkeypatch.setattr(submission, "looks", lambda client, run: iter(looks))
    words = ["submit", "generate-scenes", "smoke", "--scenes", "2", "--out", str(tmp_path)]
    told = trilight(words).stdout
    given = {"build": "smoke", "scenes": 2, "out": str(tmp_path)}
    assert asked == [("generate-scenes", None, given)]
    for line in ("Run a-run of generate-scenes/local: http://page", "Pending", "scenes  2"):
        assert told.count(line) == 1, told
    assert f"Next: trilight verify {tmp_path}" in told
    assert json.loads(trilight([*words, "--json"]).stdout)["summary"] == {"scenes": "2"}


def test_a_run_that_crashed_is_a_mistake_with_its_reason(
    asked: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = seen("Crashed", message="it was killed.")
    monkeypatch.setattr(submission, "looks", lambda client, run: iter([ended]))
    failed = trilight(["submit", "generate-scenes", "smoke"])
    assert "ended as Crashed: it was killed. Its log is at http://page" in failed.stderr


def test_who_does_not_watch_gets_the_run(asked: list[Any]) -> None:
    words = ["submit", "generate-scenes", "smoke", "--no-watch", "--deployment", "cluster"]
    assert json.loads(trilight([*words, "--json"]).stdout)["flow_run"] == str(RUN.id)
    assert asked[0][:2] == ("generate-scenes", "cluster")


def test_a_flow_that_is_none_is_told_those_there_are() -> None:
    assert "build-dataset, make-by-array, or of slurm" in trilight(["submit", "x", "smoke"]).mistake
