"""The command line in this process: what it prints, and how it ends."""

import contextlib
import io
import json
import os
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

from cyclopts import CycloptsError
from rich.console import Console

from infra.cli.commands import app, complaint
from storage.errors import TrilightError
from tests.conftest import ROOT


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    exit_code: int
    stdout: str
    stderr: str
    exception: Exception | None = None
    """The mistake that ended it, of which the real command prints one line."""

    @property
    def mistake(self) -> str:
        """The one line that a mistake becomes, without the name of the command."""
        assert self.exit_code in (1, 2) and self.stderr.count("\n") == 1, self.output
        return self.stderr.strip().removeprefix("trilight: ")

    @property
    def output(self) -> str:
        return self.stdout + self.stderr


def trilight(words: Sequence[str], env: Mapping[str, str] | None = None) -> Ended:
    """Run a command; any exception but a mistake of the user is raised."""
    out, errors = io.StringIO(), io.StringIO()
    code = 0
    caught: Exception | None = None
    with (
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(errors),
        mock.patch.dict(os.environ, env or {}),
    ):
        try:
            # cyclopts keeps the first console that it made, and with it the width
            app(list(words), console=Console(width=int(os.environ.get("COLUMNS", "80"))))
        except CycloptsError as mistake:
            code, caught = 2, mistake
            errors.write(f"trilight: {complaint(mistake)}\n")
        except TrilightError as mistake:
            code, caught = 1, mistake
            errors.write(f"trilight: {mistake}\n")
        except SystemExit as end:
            code = int(end.code or 0)
    return Ended(code, out.getvalue(), errors.getvalue(), caught)


def expect_output(*words: str | Path, **variables: str) -> str:
    """Run a command that has to end well, with further variables; return what it prints."""
    ended = trilight([*map(str, words)], variables)
    assert ended.exit_code == 0, ended.exception
    return ended.output


def expect_json(*words: str | Path) -> dict[str, Any]:
    """Return what a command prints as JSON."""
    return dict(json.loads(expect_output(*words, "--json")))


def expect_mistake(*words: str | Path) -> str:
    """Return the one line that a mistake ends in."""
    return trilight([*map(str, words)]).mistake


def run_program(
    words: Sequence[str | Path],
    folder: Path = ROOT,
    *,
    status: int = 0,
    env: Mapping[str, str] = os.environ,
    timeout: float = 900,
    **variables: str,
) -> "subprocess.CompletedProcess[str]":
    """Run a program in a folder, with further variables, and require its exit status."""
    done = subprocess.run(
        words, cwd=folder, env={**env, **variables}, capture_output=True, text=True,
        timeout=timeout, check=False,
    )  # fmt: skip
    assert done.returncode == status, f"{words}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return done
