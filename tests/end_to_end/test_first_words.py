"""Each long command speaks before it works; Ctrl-C ends it with one line that says how to go on."""

import os
import shlex
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from infra.cli.leaving import temporary_folder
from tests.end_to_end.conftest import command
from tests.for_each import for_each

SCENE = "{}"
LONG = {
    "generate": ("generate", "smoke", "--out", "set"),
    "assets": ("assets", "builtin:", "--out", "my meshes"),
    "plan": ("plan", "smoke"),
    "convert": ("convert", "scene.json", "scene.usda"),
    "inspect": ("inspect", "scene.json"),
    "verify": ("verify", "SILENT"),
    "evaluate": ("evaluate", "builtin:", "--data", "nowhere"),
    "leaderboard": ("leaderboard", "nowhere"),
    "doctor": ("doctor",),
    "view": ("view", "SILENT", "--no-browser"),
}


def _started(words: tuple[str, ...], folder: Path) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        command(*words),
        cwd=folder,
        env={**os.environ, "TMPDIR": str(folder)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.fixture
def silent_url() -> Iterator[str]:
    """Return the URL of a server that takes connections and never answers."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"http://127.0.0.1:{server.getsockname()[1]}/set"


def _leave(words: tuple[str, ...], folder: Path, begun: Callable[[], bool]) -> None:
    """Interrupt a command that has spoken once something has begun, and read how it leaves."""
    run = _started(words, folder)
    assert run.stdout is not None
    assert run.stdout.readline().rstrip().endswith(" ...")
    while not begun():
        assert run.poll() is None
        time.sleep(0.02)
    run.send_signal(signal.SIGINT)
    _, errors = run.communicate(timeout=60)
    assert run.returncode == 130, errors
    told = "trilight: interrupted. What was finished is safe; to go on, run: "
    assert errors == f"{told}{shlex.join(['trilight', *words])}\n"


@pytest.mark.slow("kills")
@for_each("name", LONG)
def test_words_come_first_and_ctrl_c_is_answered(
    name: str, silent_url: str, tmp_path: Path
) -> None:
    (tmp_path / "scene.json").write_text(SCENE)
    # verify has nothing slow to import: only a wait outlasts the signal's way
    words = tuple(silent_url if word == "SILENT" else word for word in LONG[name])
    _leave(words, tmp_path, lambda: True)


def test_plan_leaves_no_scenes_behind_at_ctrl_c(tmp_path: Path) -> None:
    _leave(LONG["plan"], tmp_path, lambda: bool(list(tmp_path.glob("trilight-plan-*"))))
    assert not list(tmp_path.glob("trilight-plan-*"))


def test_a_temporary_folder_is_gone_after_its_block() -> None:
    with temporary_folder("trilight-test-") as folder:
        (folder / "file").touch()
    assert not folder.exists()


def test_an_error_is_one_line_without_a_bar_before_it(tmp_path: Path) -> None:
    run = _started(("verify", "nowhere"), tmp_path)
    output, errors = run.communicate(timeout=60)
    assert run.returncode == 1
    assert len(errors.splitlines()) == 1
    assert output == "Verifying nowhere ...\n"
