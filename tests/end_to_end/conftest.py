"""The command line as a process, and who of its descendants is left over."""

import contextlib
import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import run_program
from tests.s3_server import moto as moto

Trilight = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def trilight(tmp_path: Path) -> Trilight:
    """Run `trilight` in an empty folder, as a user does, and require its exit status."""

    def run(*arguments: str, status: int = 0) -> "subprocess.CompletedProcess[str]":
        return run_program(command(*arguments), tmp_path, status=status)

    return run


def command(*arguments: str) -> list[str]:
    """Return the command of the installed distribution, wherever the tests run."""
    return [str(Path(sys.executable).parent / "trilight"), *arguments]


def marked_environment() -> tuple[str, dict[str, str]]:
    """Return a mark, and an environment by which every descendant can be recognised."""
    mark = f"TRILIGHT_TEST_MARK={uuid.uuid4()}"
    name, value = mark.split("=")
    return mark, {**os.environ, name: value}


def _marked(mark: str) -> Iterator[tuple[int, str]]:
    """Yield number and command line of every process that carries the mark; the dead have none."""
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if mark.encode() in (folder / "environ").read_bytes():
                yield int(folder.name), (folder / "cmdline").read_text().replace("\0", " ")


def wait_until_nobody_is_left(mark: str) -> None:
    """Wait for the end of all processes that carry the mark."""
    deadline = time.monotonic() + 30
    while (left := list(_marked(mark))) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not left


def kill_one(word: str, mark: str, rng: np.random.Generator) -> bool:
    """Kill one living process that carries the mark and has a word in its command line.

    Returns:
        Whether there was any.
    """
    found = sorted(number for number, line in _marked(mark) if word in line)
    try:
        os.kill(int(rng.choice(found)), signal.SIGKILL)
    except (ValueError, ProcessLookupError):  # nobody to choose from, or just ended
        return False
    return True


def num_meshes(cache: Path) -> int:
    """Return how many meshes are finished in a cache."""
    return len(list((cache / "assets").glob("*/*.safetensors")))
