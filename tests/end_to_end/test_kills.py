"""A run that is killed at any moment ends, when run again, in the digest of one that was not."""

import contextlib
import os
import pty
import shlex
import signal
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from pipeline.isolation import is_transient
from storage.dataset.dataset import open_dataset
from storage.dataset.verify import verify_dataset
from tests.end_to_end.conftest import (
    command,
    kill_one,
    marked_environment,
    num_meshes,
    wait_until_nobody_is_left,
)

ARGUMENTS = (
    "generate", "smoke", "--objects", "builtin:12", "--scenes", "8",
    "--resolution", "32", "--noise-floor", "20", "--seed", "0",
    "--set", "scenes.num_views=2", "--set", "renders.max_spp=64",
)  # fmt: skip
KILLS = 3


def _start(out: Path, workers: int, environment: dict[str, str]) -> "subprocess.Popen[bytes]":
    # no PREFECT_API_URL: each run has its own private server, which must end with it too
    environment = {k: v for k, v in environment.items() if k != "PREFECT_API_URL"}
    return subprocess.Popen(
        command(*ARGUMENTS, "--out", str(out), "--workers", str(workers)),
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


@dataclass(frozen=True, kw_only=True)
class Whole:
    """A dataset that nothing disturbed, made with an empty cache."""

    folder: Path
    cache: Path
    digest: str
    seconds: float


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    folder, started = tmp_path_factory.mktemp("undisturbed"), time.monotonic()
    environment = {**os.environ, "TRILIGHT_CACHE": str(folder / "cache")}
    assert _start(folder / "set", 1, environment).wait() == 0
    return Whole(
        folder=folder / "set",
        cache=folder / "cache",
        digest=open_dataset(str(folder / "set")).digest,
        seconds=time.monotonic() - started,
    )


def _wait_until(run: "subprocess.Popen[bytes]", reached: Callable[[], bool]) -> None:
    while not reached():
        assert run.poll() is None
        time.sleep(0.02)


@pytest.mark.slow("kills")
@pytest.mark.timeout(3600)
def test_killed_anywhere_ends_in_the_same_digest(tmp_path: Path, whole: Whole) -> None:
    rng = np.random.default_rng(0)
    mark, environment = marked_environment()
    cache = tmp_path / "cache"
    environment["TRILIGHT_CACHE"] = str(cache)
    for number in range(KILLS):
        run = _start(tmp_path / "killed", 2, environment)
        pause_s = rng.uniform(0.1, 0.5) * whole.seconds
        if number == 0:  # while meshes are made
            _wait_until(run, lambda: num_meshes(cache) > 5)
            assert num_meshes(cache) < num_meshes(whole.cache)
            pause_s = 0.0
        try:
            run.wait(timeout=pause_s)
            break  # it was quicker than its killer
        except subprocess.TimeoutExpired:
            run.kill()
            run.wait()
        wait_until_nobody_is_left(mark)
        for shard in (tmp_path / "killed").glob("*.tar"):
            assert shard.read_bytes() == (whole.folder / shard.name).read_bytes()
    assert _start(tmp_path / "killed", 2, environment).wait() == 0
    wait_until_nobody_is_left(mark)
    assert open_dataset(str(tmp_path / "killed")).digest == whole.digest
    assert verify_dataset(tmp_path / "killed").problems == []
    # young leftovers may be somebody's work on another machine; old ones go with the next run
    cleaned = tmp_path / "killed" / ".staging" / "cleaned"
    for left in (*(tmp_path / "killed").rglob("*.part"), cleaned):
        os.utime(left, (0, 0))
    assert _start(tmp_path / "killed", 2, environment).wait() == 0
    assert not list((tmp_path / "killed").rglob("*.part"))


@pytest.mark.slow("kills")
@pytest.mark.timeout(3600)
def test_kills_of_children_end_in_the_same_digest(tmp_path: Path, whole: Whole) -> None:
    """While meshes are made, with an empty store, and while pictures are; fork servers too.

    Two kills of meshes: a dataset is begun without an object whose children were killed three times
    (tests/pipeline/generation/test_poison.py), and all kills may hit the same one.
    """
    rng, out, cache = np.random.default_rng(0), tmp_path / "killed", tmp_path / "cache"
    mark, environment = marked_environment()
    environment["TRILIGHT_CACHE"] = str(cache)

    def num_scenes() -> int:
        return sum(len(log.read_text().splitlines()) for log in (out / "logs").glob("*.jsonl"))

    run, killed = _start(out, 2, environment), Counter[str]()
    moments = [("meshes", at) for at in (2, 7)] + [("scenes", at) for at in (1, 3, 5, 7)]
    for what, at in moments:
        while (num_meshes(cache) if what == "meshes" else num_scenes()) < at:
            if run.poll() is not None:  # three kills of one set-up end a run; it goes on
                run = _start(out, 2, environment)
            time.sleep(0.02)
        if what == "meshes":
            assert num_meshes(cache) < num_meshes(whole.cache)
        killed[what] += kill_one("multiprocessing.forkserver", mark, rng)
    run.wait()
    assert _start(out, 2, environment).wait() == 0
    assert min(killed["meshes"], killed["scenes"]) > 0
    assert [row for row in open_dataset(str(out)).failures() if is_transient(row.reason)] == []
    assert open_dataset(str(out)).digest == whole.digest
    wait_until_nobody_is_left(mark)


@pytest.mark.slow("kills")
@pytest.mark.parametrize("moment", ["meshes", "scenes"])
def test_ctrl_c_says_what_to_do_and_leaves_nobody(
    tmp_path: Path, whole: Whole, moment: str
) -> None:
    """On a terminal, where progress bars hide the cursor: it is back, and the words come last."""
    mark, environment = marked_environment()
    environment.pop("PREFECT_API_URL", None)
    cache = tmp_path / "cache" if moment == "meshes" else whole.cache
    environment |= {"TRILIGHT_CACHE": str(cache), "TERM": "xterm"}
    ours, theirs = pty.openpty()
    run = subprocess.Popen(
        command(*ARGUMENTS, "--out", str(tmp_path / "set")),
        env=environment,
        stdout=theirs,
        stderr=theirs,
    )
    os.close(theirs)
    shown = bytearray()
    reader = threading.Thread(target=_read_all, args=(ours, shown))
    reader.start()
    staged = tmp_path / "set" / ".staging" / "samples"
    if moment == "meshes":
        _wait_until(run, lambda: num_meshes(cache) > 5)
    else:
        _wait_until(run, lambda: bool(list(staged.glob("*/*.tar"))))
    run.send_signal(signal.SIGINT)
    assert run.wait(timeout=30) == 130
    reader.join()
    again = shlex.join(["trilight", *ARGUMENTS, "--out", str(tmp_path / "set")])
    told = f"trilight: interrupted. What was finished is safe; to go on, run: {again}"
    assert bytes(shown).rstrip().endswith(told.encode())
    assert shown.rfind(b"\x1b[?25h") > shown.rfind(b"\x1b[?25l") >= 0
    wait_until_nobody_is_left(mark)


def _read_all(terminal: int, shown: bytearray) -> None:
    with contextlib.suppress(OSError), open(terminal, "rb", buffering=0) as stream:
        while data := stream.read(1 << 16):
            shown.extend(data)
