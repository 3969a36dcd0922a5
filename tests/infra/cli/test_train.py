"""What a person who types `trilight train` reads, and what Ctrl-C does, in real processes."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NoReturn

import pytest

from infra.cli.console import progress_bars
from infra.cli.train import _BarProgress, _QuietProgress
from storage.errors import TrilightError
from tests.command_line import trilight
from tests.conftest import ROOT
from tests.train.toy import write_toy_dataset
from train.loop.checkpoints import saved_steps
from train.loop.interrupts import SAVED_STATUS
from train.watching.rows import read_rows

TRILIGHT = [sys.executable, "-m", "trilight"]
TINY = {
    "resolution": 16,
    "model.width": 36,
    "model.hidden_width": 48,
    "model.rope_num_freqs": 1,
    "model.encoder_layers": 1,
    "model.decoder_layers": 1,
    "views_per_scene": 2,
    "log_every": 1,
}


def test_mistakes_and_the_first_words_come_before_torch(tmp_path: Path) -> None:
    """Torch takes seconds to import; here it cannot be."""
    asked = {
        "smok": ["smok"],
        "widht": ["smoke", "--set", "widht=3"],
        "finetune": ["finetune"],
        "change": ["smoke", "--change", "seed=1"],
        "resume": ["smoke", "--resume", "--change", "seed=1", "--set", "log_every=5"],
        "steps": ["smoke", "--steps", "24"],
    }
    words = [["train", *each, "--data", str(tmp_path)] for each in asked.values()]
    code = (
        "import json, sys; sys.modules['torch'] = None\n"
        "from tests.command_line import trilight\n"
        "for words in json.loads(sys.argv[1]):\n"
        "    ended = trilight(words)\n"
        "    print(json.dumps([ended.exit_code, ended.stdout, ended.stderr]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, json.dumps(words)],
        cwd=ROOT, capture_output=True, text=True, check=True, env=os.environ | {"COLUMNS": "200"},
    )  # fmt: skip
    ended = dict(zip(asked, map(json.loads, done.stdout.splitlines()), strict=True))
    assert {name: status for name, (status, *_) in ended.items()} == dict.fromkeys(asked, 1)
    said = {name: mistake for name, (_, _, mistake) in ended.items()}
    assert "run 'smok': no such run; did you mean smoke?" in said["smok"]
    assert "setting 'widht' does not exist" in said["widht"]
    assert "expected begin_with" in said["finetune"]
    assert "it has not begun, so --change seed changes nothing" in said["change"]
    assert "Run smoke goes on. Loading torch and the checkpoint" in ended["resume"][1]
    first = ended["steps"][1]
    assert "warmup_steps=3, log_every=1, validate_every=4, checkpoint_every=4" in first
    assert "Run smoke: 24 steps of 4 scenes at 64 pixels. Loading torch" in first
    assert "train needs PyTorch, which is not installed" in said["steps"]


@pytest.mark.slow("kills")
def test_a_run_that_is_stopped_says_what_goes_on_and_that_does(tmp_path: Path) -> None:
    """As printed, in a folder with a blank in its name; threads wait without burning a core."""
    data = write_toy_dataset(tmp_path / "the data", train=4, validation=0, resolution=16)
    out = tmp_path / "my runs" / "first"
    command = ["train", "smoke", "--data", str(data.folder.root), "--out", str(out)]
    command += ["--device", "cpu", "--set", "checkpoint_every=50000", "--steps", "100000"]
    command += [part for name, value in TINY.items() for part in ("--set", f"{name}={value}")]
    words, mistake = _stopped_after(command, out, 1)
    assert "Stopping after this step" in words
    assert "the data has no validation split" in words
    assert "GOMP_SPINCOUNT = '0'" in mistake, "libgomp itself says so, as torch loads it"
    found = re.search(r"training: stopped at step (\d+), nothing is lost\. To go on: (.*)", mistake)
    assert found, mistake
    (saved,) = saved_steps(out / "checkpoints")
    assert int(found[1]) == saved
    name, *again = shlex.split(found[2])
    assert (name, again) == ("trilight", [*command, "--resume"])
    _, mistake = _stopped_after(again, out, saved + 1)
    assert found[2] in mistake, "once more the same, with one --resume"
    assert saved_steps(out / "checkpoints")[-1] > saved


def test_a_run_that_is_stopped_says_what_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In this process; the slow test types what is said here, in real ones."""
    data = write_toy_dataset(tmp_path / "the data", train=4, validation=0, resolution=16)
    out = tmp_path / "my runs" / "first"
    command = ["train", "smoke", "--data", str(data.folder.root), "--out", str(out)]
    command += ["--device", "cpu", "--set", "checkpoint_every=50000", "--steps", "100000"]
    command += [part for name, value in TINY.items() for part in ("--set", f"{name}={value}")]
    monkeypatch.setattr(sys, "argv", ["trilight", *command, "--resume"])
    advance = _BarProgress.advance
    steps: list[int] = []

    def interrupt(progress: _BarProgress, **facts: Any) -> None:
        """Press Ctrl-C after the first step."""
        advance(progress, **facts)
        steps.append(facts["step"])
        if len(steps) == 1:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(_BarProgress, "advance", interrupt)
    ended = trilight(command, env={"COLUMNS": "200"})
    assert isinstance(ended.exception, TrilightError)
    assert ended.exception.exit_status == SAVED_STATUS
    assert "Stopping after this step" in ended.stdout
    (saved,) = saved_steps(out / "checkpoints")
    again = shlex.join(["trilight", *command, "--resume"])
    assert ended.mistake.endswith(f"stopped at step {saved}, nothing is lost. To go on: {again}")


def _stopped_after(arguments: list[str], out: Path, step: int) -> tuple[str, str]:
    """Return what a run says, and what on stderr, that gets Ctrl-C when its log has a step."""
    unset = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    started = subprocess.Popen(
        [*TRILIGHT, *arguments],
        cwd=ROOT,
        env=unset | {"OMP_DISPLAY_ENV": "verbose", "OMP_NUM_THREADS": "1", "COLUMNS": "200"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    while started.poll() is None and not any(
        row["step"] >= step for row in read_rows(out / "metrics.jsonl")
    ):
        time.sleep(0.05)
    started.send_signal(signal.SIGINT)
    words, mistake = started.communicate()
    assert started.returncode == SAVED_STATUS, mistake
    return words, mistake


def test_a_second_ctrl_c_ends_a_step_that_does_not(tmp_path: Path) -> None:
    """The step is a call into C that hears no signal, as a backward pass."""
    code = (
        "import ctypes, time\n"
        "from infra.cli.console import progress_bars\n"
        "from infra.cli.train import _BarProgress\n"
        "from train.loop.interrupts import deferred_interrupts\n"
        "c, mutex = ctypes.CDLL(None), (ctypes.c_byte * 64)()\n"
        "c.pthread_mutex_lock(mutex)\n"
        "until = (ctypes.c_long * 2)(int(time.time()) + 300, 0)\n"
        "with progress_bars() as bars, deferred_interrupts(_BarProgress(bars).interrupted):\n"
        "    print('in the step', flush=True)\n"
        "    c.pthread_mutex_timedlock(mutex, until)\n"
    )
    started = subprocess.Popen(
        [sys.executable, "-u", "-c", code],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert started.stdout is not None
    assert started.stdout.readline() == "in the step\n"
    started.send_signal(signal.SIGINT)
    assert "Stopping after this step" in started.stdout.readline()
    time.sleep(1.1)  # closer together they are one asking
    started.send_signal(signal.SIGINT)
    _, mistake = started.communicate(timeout=120)
    assert started.returncode == 130, mistake
    assert "ended at once; --resume goes on from the last checkpoint" in mistake


@pytest.mark.parametrize("quiet", [False, True])
def test_a_run_that_hangs_and_is_to_stop_ends_with_status_1(
    quiet: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ended: list[int] = []
    monkeypatch.setattr(os, "_exit", ended.append)
    with progress_bars() as bars:
        (_QuietProgress() if quiet else _BarProgress(bars)).hung("training: step 7 hangs")
    assert ended == [1]
    said = capsys.readouterr().err
    assert "trilight: training: step 7 hangs; --resume goes on from the last checkpoint." in said


def test_how_it_is_watched_is_passed_on_to_all_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[list[str]] = []

    def replaced(program: str, words: list[str]) -> NoReturn:
        seen.append(words)
        sys.exit(0)

    monkeypatch.setattr(os, "execv", replaced)
    asked = ["train", "smoke", "--processes", "2", "--hang-after", "9", "--profile", "2"]
    assert trilight([*asked, "--wandb", "light"]).exit_code == 0
    assert " ".join(seen[0][6:]) == (
        "trilight train smoke --hang-after-s 9.0 --profile 2 --wandb light"
    )


def test_a_wait_policy_of_the_users_own_stays() -> None:
    code = (
        "import os, sys; sys.argv = ['trilight', '--help']\n"
        "from infra.cli.app import main\n"
        "try:\n    main()\nfinally:\n    print(os.environ['OMP_WAIT_POLICY'])"
    )
    for own, expected in (({}, "PASSIVE"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE")):
        unset = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=ROOT, env=unset | own, capture_output=True, text=True
        )
        assert done.stdout.splitlines()[-1] == expected


def test_several_processes_are_launched_by_torchrun(monkeypatch: pytest.MonkeyPatch) -> None:
    """As one command line; under torchrun it would be twice as many."""
    seen: list[list[str]] = []

    def replaced(program: str, words: list[str]) -> NoReturn:
        seen.append(words)
        sys.exit(0)

    monkeypatch.setattr(os, "execv", replaced)
    asked = ["train", "smoke", "--processes", "2", "--set", "seed=3", "--skip-unusable", "1"]
    assert trilight([*asked, "--json"]).exit_code == 0
    (words,) = seen
    assert words[1:6] == ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", "-m"]
    assert " ".join(words[6:]) == "trilight train smoke --most-unusable 1 --changes seed=3 --json"
    monkeypatch.setenv("RANK", "0")
    assert trilight(asked).mistake.startswith("--processes is 2 under torchrun")
    assert len(seen) == 1
