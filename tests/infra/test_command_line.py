"""What every command has in common: help that says all, completion, a version, near names."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from rich.text import Text

from tests.command_line import trilight
from tests.conftest import ROOT
from tests.end_to_end.conftest import command

SHELLS = {"bash": "complete_bash", "zsh": "complete_zsh", "fish": "complete_fish"}
EXPECTED_FILES = {
    "bash": ".bash_completions/trilight.sh",
    "zsh": ".zfunc/_trilight",
    "fish": ".config/fish/completions/trilight.fish",
}


def _commands(parent: Any) -> Iterator[tuple[str, Any]]:
    for name in parent.list_commands(None):
        found = parent.get_command(None, name)
        yield name, found
        if hasattr(found, "list_commands"):
            yield from _commands(found)


COMMANDS = dict(_commands(typer.main.get_command(app)))


@pytest.mark.parametrize("name", COMMANDS)
def test_no_help_text_loses_its_default(name: str) -> None:
    """Rich takes `[builtin:]` for a style and drops it."""
    found = COMMANDS[name]
    for text in (found.help, *(parameter.help for parameter in found.params)):
        assert Text.from_markup(text).plain == text.replace("\\[", "[")


def test_the_default_of_objects_is_seen() -> None:
    shown = trilight(["generate", "--help"], env={"COLUMNS": "200"}).output
    assert "builtin: or objaverse: [builtin:]" in " ".join(shown.split())


def test_the_short_option_helps_everywhere() -> None:
    for words in (["-h"], ["verify", "-h"], ["shards", "-h"], ["shards", "merge", "-h"]):
        shown = trilight(words)
        assert shown.exit_code == 0
        assert "Usage:" in shown.output


def test_the_version_is_that_of_the_distribution() -> None:
    shown = trilight(["--version"])
    assert (shown.exit_code, shown.output.split()[0]) == (0, "trilight")
    assert shown.output.split()[1][0].isdigit()


def _run(words: list[str], environment: dict[str, str]) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        words, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120, check=False
    )


def test_usage_names_the_command_and_no_module() -> None:
    found = _run([sys.executable, "-m", "infra.cli.app", "verify"], dict(os.environ))
    assert found.returncode == 2
    assert "infra.cli" not in found.stderr
    assert "Usage: trilight verify" in found.stderr


@pytest.mark.parametrize(("typed", "meant"), [("evaluat", "evaluate"), ("shard", "shards")])
def test_a_mistyped_command_brings_the_near_one(typed: str, meant: str) -> None:
    shown = trilight([typed])
    assert shown.exit_code == 2
    assert f"Did you mean '{meant}'" in shown.output


def test_a_mistyped_option_brings_the_near_one() -> None:
    shown = trilight(["generate", "smoke", "--objekts", "x"])
    assert "--objects" in shown.output


@pytest.mark.parametrize("shell", SHELLS)
def test_completion_installs_and_completes(shell: str, tmp_path: Path) -> None:
    """In a home of its own; the shell itself asks as this test does."""
    home = {
        **os.environ,
        "HOME": str(tmp_path),
        "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1",
    }
    installed = _run(command("--install-completion", shell), home)
    assert installed.returncode == 0, installed.stderr
    assert (tmp_path / EXPECTED_FILES[shell]).is_file()
    asked = {
        **os.environ,
        "_TRILIGHT_COMPLETE": SHELLS[shell],
        "COMP_WORDS": "trilight generate pre",  # of bash
        "COMP_CWORD": "2",
        "_TYPER_COMPLETE_ARGS": "trilight generate pre",  # of zsh and fish
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
    }
    completed = _run(command(), asked)
    assert "pretrain-256" in completed.stdout
    assert "smoke" not in completed.stdout
