"""`trilight submit kubernetes`: files, commands that run as printed, refusals."""

import json
import os
import subprocess
from pathlib import Path

import pytest

from pipeline.executors import array_job as arrays
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
