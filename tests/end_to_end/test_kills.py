"""A run that is killed at any moment ends, when run again, in the digest of one that was not."""

import os
import shlex
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from storage.dataset import open_dataset
from storage.verify import verify_dataset
from tests.end_to_end.conftest import command, marked_environment, processes_with

ARGUMENTS = (
    "generate", "smoke", "--objects", "builtin:", "--scenes", "24",
    "--resolution", "32", "--noise-floor", "20", "--seed", "0",
)  # fmt: skip
KILLS = 6


def _start(out: Path, workers: int, environment: dict[str, str]) -> "subprocess.Popen[bytes]":
    # no PREFECT_API_URL: each run has its own private server, which must end with it too
    environment = {k: v for k, v in environment.items() if k != "PREFECT_API_URL"}
    return subprocess.Popen(
        command(*ARGUMENTS, "--out", str(out), "--workers", str(workers)),
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def _wait_until_nobody_is_left(mark: str) -> None:
    deadline = time.monotonic() + 15
    while (left := processes_with(mark)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not left


@pytest.mark.slow
def test_killed_anywhere_ends_in_the_same_digest(tmp_path: Path) -> None:
    started = time.monotonic()
    assert _start(tmp_path / "whole", 1, dict(os.environ)).wait() == 0
    whole_s = time.monotonic() - started
    expected = open_dataset(str(tmp_path / "whole")).digest

    rng = np.random.default_rng(0)
    mark, environment = marked_environment()
    for _ in range(KILLS):
        run = _start(tmp_path / "killed", 2, environment)
        try:
            run.wait(timeout=rng.uniform(0.1, 0.5) * whole_s)
            break  # it was quicker than its killer
        except subprocess.TimeoutExpired:
            run.kill()
            run.wait()
        _wait_until_nobody_is_left(mark)
        for shard in (tmp_path / "killed").glob("*.tar"):
            assert shard.read_bytes() == (tmp_path / "whole" / shard.name).read_bytes()
    assert _start(tmp_path / "killed", 2, environment).wait() == 0
    _wait_until_nobody_is_left(mark)
    assert open_dataset(str(tmp_path / "killed")).digest == expected
    assert verify_dataset(tmp_path / "killed").problems == []
    # young leftovers may be somebody's work on another machine; old ones go with the next run
    for left in (tmp_path / "killed").rglob("*.part"):
        os.utime(left, (0, 0))
    assert _start(tmp_path / "killed", 2, environment).wait() == 0
    assert not list((tmp_path / "killed").rglob("*.part"))


@pytest.mark.slow
def test_ctrl_c_says_what_to_do_and_leaves_nobody(tmp_path: Path) -> None:
    mark, environment = marked_environment()
    environment.pop("PREFECT_API_URL", None)
    run = subprocess.Popen(
        command(*ARGUMENTS, "--out", str(tmp_path / "set")),
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    while not list((tmp_path / "set" / ".staging" / "samples").glob("*/*.tar")):
        assert run.poll() is None
        time.sleep(0.2)
    run.send_signal(signal.SIGINT)
    _, errors = run.communicate(timeout=30)
    assert run.returncode == 130
    again = shlex.join(["trilight", *ARGUMENTS, "--out", str(tmp_path / "set")])
    told = "trilight: interrupted. What was finished is safe; to go on, run:"
    assert errors.strip() == f"{told} {again}"
    _wait_until_nobody_is_left(mark)
