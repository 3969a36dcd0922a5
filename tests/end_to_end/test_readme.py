"""The commands of the README do what it says."""

import os
import re
import shlex
import subprocess
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.end_to_end.production_kit import copy_of_the_project

README = (ROOT / "README.md").read_text()
COMMANDS = [
    line.split("#")[0].strip()
    for block in re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
    for line in block.splitlines()
    if line.strip()
]
NOT_RUN_HERE = {"make test"}
"""This very test is part of it."""


def test_the_readme_shows_commands() -> None:
    assert {"make dataset", "make test", "make train"} <= set(COMMANDS)
    assert any(command.startswith("trilight generate") for command in COMMANDS)


@pytest.mark.parametrize("target", re.findall(r"\[[^\]]*\]\(([^)#:]+)\)", README))
def test_links_lead_somewhere(target: str) -> None:
    assert (ROOT / target).exists()


def test_every_folder_has_its_line() -> None:
    folders = [p for p in (ROOT / "pipeline").iterdir() if p.is_dir() and p.name[0] not in "_."]
    tops = ("storage", "scene_templates", "model", "train", "infra", "tests")
    for name in [*tops, *(f"pipeline/{folder.name}" for folder in folders)]:
        assert f"`{name}/`" in README, name


def _run(command: str, folder: Path) -> None:
    environment = {k: v for k, v in os.environ.items() if k not in ("MAKEFLAGS", "MAKELEVEL")}
    environment["PATH"] = f"{ROOT / '.venv' / 'bin'}:{environment['PATH']}"
    result = subprocess.run(
        ["sh", "-c", command],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=1500,
        check=False,
    )
    assert result.returncode == 0, f"{command}\n{result.stdout[-2000:]}\n{result.stderr[-2000:]}"


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_commands_run(tmp_path: Path, shared: Path) -> None:
    """All of them, in order; only the user's own dataset and training are smaller."""
    copy_of_the_project(tmp_path)
    for command in COMMANDS:
        if command in NOT_RUN_HERE:
            continue
        command = command.replace("FOLDER", shlex.quote(str(shared / "objects")))
        command = command.replace("--scenes 64", "--scenes 12")
        _run(command.replace("--out runs/mine", "--out runs/mine --steps 60"), tmp_path)
    for made in ("data/smoke/contact_sheet.png", "runs/smoke/validation_sheet.png"):
        assert (tmp_path / made).stat().st_size > 10_000
    assert (tmp_path / "runs" / "mine" / "validation_sheet.png").exists()
