"""The command line as a process, and who of its descendants is left over."""

import contextlib
import os
import signal
import subprocess
import sys
import uuid
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from infra.cli.app import main

Trilight = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def trilight(tmp_path: Path) -> Trilight:
    """Run `trilight` with arguments in an empty folder, as a user does."""

    def run(*arguments: str) -> "subprocess.CompletedProcess[str]":
        return subprocess.run(
            command(*arguments),
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=600,
            check=False,
        )

    return run


@pytest.fixture
def refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    """Run `trilight` with a mistake in this process, which spares its imports; return its line."""

    def leave(message: str, status: int) -> None:
        sys.stderr.write(f"{message}\n")
        raise SystemExit(status)

    def run(*arguments: str) -> str:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["trilight", *arguments])
        monkeypatch.setenv("OMP_WAIT_POLICY", "PASSIVE")  # as main would, for good
        monkeypatch.setattr("infra.cli.app.leave", leave)
        monkeypatch.setattr(signal, "signal", lambda number, handler: None)
        with pytest.raises(SystemExit) as left:
            main()
        printed = capsys.readouterr()
        assert left.value.code in (1, 2), printed.out  # 2: no command line at all
        (line,) = [line for line in printed.err.splitlines() if line.strip()]
        assert line.startswith("trilight: ")
        return line

    return run


def command(*arguments: str) -> list[str]:
    """Return the command of the installed distribution, wherever the tests run."""
    return [str(Path(sys.executable).parent / "trilight"), *arguments]


def marked_environment() -> tuple[str, dict[str, str]]:
    """Return a mark, and an environment by which every descendant can be recognised."""
    mark = f"TRILIGHT_TEST_MARK={uuid.uuid4()}"
    name, value = mark.split("=")
    return mark, {**os.environ, name: value}


def processes_with(mark: str) -> list[str]:
    """Return the command lines of all living processes that carry the mark."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            alive = (folder / "stat").read_text().rsplit(")")[-1].split()[0] != "Z"
            if alive and mark.encode() in (folder / "environ").read_bytes():
                found.append((folder / "cmdline").read_text().replace("\0", " "))
        except OSError:
            continue
    return found


def kill_one(word: str, mark: str, rng: np.random.Generator) -> bool:
    """Kill one living process that carries the mark and has a word in its command line.

    Returns:
        Whether there was any.
    """
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            carries = mark.encode() in (folder / "environ").read_bytes()  # the dead have none
            line = (folder / "cmdline").read_bytes().replace(b"\0", b" ")
            if carries and word.encode() in line:
                found.append(int(folder.name))
    try:
        os.kill(int(rng.choice(sorted(found))), signal.SIGKILL)
    except (ValueError, ProcessLookupError):  # nobody to choose from, or just ended
        return False
    return True


def num_meshes(cache: Path) -> int:
    """Return how many meshes are finished in a cache."""
    return len(list((cache / "assets").glob("*/*.safetensors")))
