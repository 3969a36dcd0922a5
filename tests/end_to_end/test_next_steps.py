"""What commands say first and last: words before work, and next steps that run as printed."""

import json
import os
import shlex
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from storage.dataset.manifest import read_manifest
from tests.command_line import run_program
from tests.conftest import ROOT
from tests.end_to_end.conftest import Trilight, command
from tests.end_to_end.production_kit import SIXTEEN_SAMPLES
from tests.for_each import for_each

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
def test_words_come_first_and_ctrl_c_is_answered(name: str, tmp_path: Path) -> None:
    (tmp_path / "scene.json").write_text("{}")
    with socket.create_server(("127.0.0.1", 0)) as server:  # takes connections, and never answers
        url = f"http://127.0.0.1:{server.getsockname()[1]}/set"
        # verify has nothing slow to import: only a wait outlasts the signal's way
        words = tuple(url if word == "SILENT" else word for word in LONG[name])
        _leave(words, tmp_path, lambda: True)


def test_plan_leaves_no_scenes_behind_at_ctrl_c(tmp_path: Path) -> None:
    _leave(LONG["plan"], tmp_path, lambda: bool(list(tmp_path.glob("trilight-plan-*"))))
    assert not list(tmp_path.glob("trilight-plan-*"))


def test_ctrl_c_while_libraries_are_loaded_leaves_no_traceback(tmp_path: Path) -> None:
    (tmp_path / "cyclopts.py").write_text("import signal\nsignal.raise_signal(signal.SIGINT)\n")
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    assert run_program(command("doctor"), status=130, PYTHONPATH=path).stderr == ""


def test_an_error_is_one_line_without_a_bar_before_it(tmp_path: Path) -> None:
    run = _started(("verify", "nowhere"), tmp_path)
    output, errors = run.communicate(timeout=60)
    assert run.returncode == 1
    assert len(errors.splitlines()) == 1
    assert output == "Verifying nowhere ...\n"


SMALL = ("--resolution", "64", "--noise-floor", "15", *SIXTEEN_SAMPLES)
MINE = "data/my set's"


def _next_steps(printed: str) -> list[list[str]]:
    """Return the words of the commands after `Next:`, without `trilight`."""
    lines = printed.split("Next: ")[1].splitlines() if "Next: " in printed else []
    commands = [shlex.split(line) for line in lines if line.strip().startswith("trilight ")]
    return [words[1:] for words in commands]


def _ran(trilight: Trilight, *words: str, status: int = 0) -> list[list[str]]:
    return _next_steps(trilight(*words, status=status).stdout)


@pytest.mark.slow("commands")
def test_what_generate_names_runs_for_eight_scenes(trilight: Trilight, tmp_path: Path) -> None:
    """Eight scenes are two shards, both for training: no validation split is there.

    Training goes on without one, and `--steps` takes its warm-up along.
    """
    steps = _ran(trilight, "generate", "smoke", "--out", MINE, "--scenes", "8", *SMALL)
    assert [words[0] for words in steps] == ["verify", "view", "train"]
    verify, view, train = steps
    assert view == ["view", MINE]  # a page that waits for Ctrl-C: test_view opens it
    _ran(trilight, *verify)
    assert _ran(trilight, "status", MINE) == [["verify", MINE]]

    halves = ("--split", "train", "--out", "data/a part")
    assert _ran(trilight, "shards", "select", MINE, *halves) == [["verify", "data/a part"]]
    _ran(trilight, "verify", "data/a part")

    root = tmp_path / MINE
    whole = {path.name: path.read_bytes() for path in root.glob("*.tar")}
    kept, shard = (root / f"train-00000{number}.tar" for number in range(2))
    manifest, made_ns = read_manifest(root / "manifest.json"), kept.stat().st_mtime_ns
    shard.write_bytes(whole[shard.name][:-1])
    (repair,) = _ran(trilight, "verify", MINE, status=1)
    assert repair == ["verify", MINE, "--repair"]
    told = json.loads(trilight("verify", MINE, "--json", status=1).stdout)
    assert told["bad_shards"] == [shard.name]
    assert _ran(trilight, *repair) == []
    assert {path.name: path.read_bytes() for path in root.glob("*.tar")} == whole
    assert read_manifest(root / "manifest.json") == manifest
    assert kept.stat().st_mtime_ns == made_ns, "only the bad one is made anew"
    assert not list(root.glob("*.bad"))
    _ran(trilight, *train, "--steps", "4")


@pytest.mark.slow("commands")
def test_an_unfinished_set_names_the_command_that_finishes_it(
    trilight: Trilight, tmp_path: Path
) -> None:
    """With all that was asked: a seed, few objects of one kind, another setting."""
    asked = ("--scenes", "8", "--seed", "7", "--objects", "builtin:40", *SMALL)
    changed = ("--set", "scenes.num_views=1", "--set", 'storage.profile="lossless"')
    begun = ("generate", "smoke", "--out", MINE, *asked, *changed)
    (status,) = _ran(trilight, *begun, "--shards", "0:1")
    assert status == ["status", MINE]
    (goes_on,) = _ran(trilight, *status)
    verified = trilight("verify", MINE, status=1).stdout
    assert "Unfinished" in verified and "1 of 2" in verified
    assert _next_steps(verified) == [goes_on]
    steps = _ran(trilight, *goes_on)
    assert [words[0] for words in steps] == ["verify", "view"]  # one view is too few for smoke
    _ran(trilight, *steps[0])


@pytest.mark.slow("commands")
@pytest.mark.parametrize("count", [1, 3])
def test_what_assets_names_runs_with_however_few_objects(
    count: int, trilight: Trilight, tmp_path: Path
) -> None:
    """One object is of one split, and three are of two at most."""
    out = ("--out", "my meshes")
    (generate,) = _ran(trilight, "assets", f"builtin:{count}", *out, "--budget", "200")
    assert generate[:4] == ["generate", "smoke", "--objects", "my meshes"]
    small = [] if "--scenes" in generate else ["--scenes", "4"]
    _ran(trilight, *generate, *small, *SMALL, "--set", "scenes.num_views=1")


@pytest.mark.slow("commands")
def test_what_plan_names_is_what_was_priced(trilight: Trilight, tmp_path: Path) -> None:
    asked = ("--objects", "builtin:40", "--seed", "3", "--set", "scenes.num_views=1", *SMALL)
    (generate,) = _ran(trilight, "plan", "smoke", "--scenes", "4", "--samples", "4", *asked)
    assert generate[generate.index("--objects") + 1] == "builtin:40"
    _ran(trilight, *generate)
    manifest = read_manifest(tmp_path / "data" / "smoke" / "manifest.json")
    assert manifest.num_samples == 4
    made = manifest.settings
    assert made["seed"] == 3
    assert made["scenes"]["num_views"] == 1
    assert (made["renders"]["resolution"], made["renders"]["noise_floor_db"]) == (64, 15.0)
