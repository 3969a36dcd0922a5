"""A run that is killed at any moment ends, when run again, in the digest of one that was not."""

import contextlib
import json
import os
import pty
import shlex
import signal
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from storage.dataset.dataset import open_dataset
from storage.dataset.manifest import shard_row
from storage.dataset.verify import verify_dataset
from tests.end_to_end.conftest import (
    command,
    kill_one,
    marked_environment,
    num_meshes,
    wait_until_nobody_is_left,
)
from tests.end_to_end.production_kit import call, postgres, served, start_served, stop_served

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


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    """Return a folder with its cache and a set that nothing disturbed, and the seconds it took."""
    folder, started = tmp_path_factory.mktemp("undisturbed"), time.monotonic()
    environment = {**os.environ, "TRILIGHT_CACHE": str(folder / "cache")}
    assert _start(folder / "set", 1, environment).wait() == 0
    return folder, time.monotonic() - started


def _wait_until(run: "subprocess.Popen[bytes]", reached: Callable[[], bool]) -> None:
    while not reached():
        assert run.poll() is None
        time.sleep(0.02)


@pytest.mark.slow("kills")
@pytest.mark.timeout(3600)
def test_killed_anywhere_ends_in_the_same_digest(tmp_path: Path, whole: tuple[Path, float]) -> None:
    rng = np.random.default_rng(0)
    undisturbed, seconds = whole
    mark, environment = marked_environment()
    cache = tmp_path / "cache"
    environment["TRILIGHT_CACHE"] = str(cache)
    for number in range(KILLS):
        run = _start(tmp_path / "killed", 2, environment)
        pause_s = rng.uniform(0.1, 0.5) * seconds
        if number == 0:  # while meshes are made
            _wait_until(run, lambda: num_meshes(cache) > 5)
            assert num_meshes(cache) < num_meshes(undisturbed / "cache")
            pause_s = 0.0
        try:
            run.wait(timeout=pause_s)
            break  # it was quicker than its killer
        except subprocess.TimeoutExpired:
            run.kill()
            run.wait()
        wait_until_nobody_is_left(mark)
        for shard in (tmp_path / "killed").glob("*.tar"):
            assert shard.read_bytes() == (undisturbed / "set" / shard.name).read_bytes()
    assert _start(tmp_path / "killed", 2, environment).wait() == 0
    wait_until_nobody_is_left(mark)
    expected = open_dataset(str(undisturbed / "set")).digest
    assert open_dataset(str(tmp_path / "killed")).digest == expected
    assert verify_dataset(tmp_path / "killed").problems == []
    # young leftovers may be somebody's work on another machine; old ones go with the next run
    cleaned = tmp_path / "killed" / ".staging" / "cleaned"
    for left in (*(tmp_path / "killed").rglob("*.part"), cleaned):
        os.utime(left, (0, 0))
    assert _start(tmp_path / "killed", 2, environment).wait() == 0
    assert not list((tmp_path / "killed").rglob("*.part"))


@pytest.mark.slow("kills")
@pytest.mark.parametrize("moment", ["meshes", "scenes"])
def test_ctrl_c_says_what_to_do_and_leaves_nobody(
    tmp_path: Path, whole: tuple[Path, float], moment: str
) -> None:
    """On a terminal, where progress bars hide the cursor: it is back, and the words come last."""
    mark, environment = marked_environment()
    environment.pop("PREFECT_API_URL", None)
    cache = (tmp_path if moment == "meshes" else whole[0]) / "cache"
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


CHAOS_KILLS = int(os.environ.get("TRILIGHT_CHAOS_KILLS", "4"))
"""One of each kind; 8 take ten minutes, 30 half an hour and more: ask for them by the variable."""
SCENES = 4 * -(-CHAOS_KILLS // 2)
"""Two for each kill, in whole shards of four."""
OBJECTS = 12
WORDS = {
    "flow": "prefect.engine",
    "child": "multiprocessing.forkserver",
    "worker": "worker start",
    "server": "pipeline.flows.guarded_server",
}
"""By what a process is known among those that carry the test's mark."""
SHARES = {"child": 0.5, "flow": 0.3, "worker": 0.1, "server": 0.1}
"""Of the victims after one of each kind; a worker or server takes half a minute to come back."""
LOOK_S = 0.1
"""Between two looks for a victim that is not there yet, such as a child of a flow that starts."""
LOOK_EVERY_S = 0.2
"""Between two looks of the watcher."""
FLOW_S = 600


def _parameters(out: Path) -> list[str]:
    parameters = {
        "objects": f"builtin:{OBJECTS}", "scenes": SCENES, "resolution": 32, "noise_floor_db": 20,
        "out": out,
    }  # fmt: skip
    return [word for key, value in parameters.items() for word in ("-p", f"{key}={value}")]


def _next_kind(killed: Counter[str], rng: np.random.Generator) -> str:
    """Return each kind once, those that only work brings first, and then kinds by their shares."""
    left = [kind for kind in SHARES if not killed[kind]]
    return left[0] if left else str(rng.choice(list(SHARES), p=list(SHARES.values())))


@contextlib.contextmanager
def _watched(out: Path, whole: Path) -> Iterator[list[str]]:
    """Compare what is visible under a final name with what it must be, all the time.

    Whatever goes wrong in the thread is told too: a watcher that died would have seen nothing.
    """
    wrong: list[str] = []
    ended = threading.Event()

    def look() -> None:
        while not ended.wait(LOOK_EVERY_S):
            try:
                wrong.extend(_wrong_now(out, whole))
            except Exception as error:
                wrong.append(repr(error))

    watcher = threading.Thread(target=look)
    watcher.start()
    try:
        yield wrong
    finally:
        ended.set()
        watcher.join()


def _wrong_now(out: Path, whole: Path) -> Iterator[str]:
    """Yield what is visible and is not as it must be; raises for what cannot be read at all."""
    listed = open_dataset(str(out)).manifest.shards if (out / "manifest.json").exists() else ()
    expected = {shard.name: shard for shard in open_dataset(str(whole)).manifest.shards}
    for shard in out.glob("*.tar"):
        if shard.read_bytes() != (whole / shard.name).read_bytes():
            yield shard.name
    for entry in listed:  # read before: a shard is there before the manifest says so
        if not (out / entry.name).exists():
            yield f"{entry.name} is listed and not there"
        if shard_row(entry) != shard_row(expected[entry.name]):
            yield f"{entry.name} is listed as another one"
    for path in out.glob("*.json"):
        json.loads(path.read_text())
    for path in out.glob("*.jsonl"):
        for line in path.read_text().splitlines():
            json.loads(line)


@pytest.mark.slow("kills")
@pytest.mark.timeout(3600)
def test_kills_of_everything_end_in_the_same_digest(tmp_path: Path) -> None:
    size = ["--scenes", str(SCENES), "--resolution", "32", "--noise-floor", "20"]
    plain = ["-m", "trilight", "generate", "smoke", "--objects", f"builtin:{OBJECTS}", *size]
    call([*plain, "--out", str(tmp_path / "whole")], os.environ, FLOW_S)
    expected = open_dataset(str(tmp_path / "whole")).digest
    rng, out = np.random.default_rng(0), tmp_path / "set"
    mark, marked = marked_environment()
    cold = tmp_path / "cache"
    marked["TRILIGHT_CACHE"] = str(cold)
    run = ["-m", "prefect", "deployment", "run", "generate-scenes/local", *_parameters(out)]
    with (
        postgres() as database,
        _watched(out, tmp_path / "whole") as wrong,
        served(tmp_path, database.url, 1, marked) as environment,
    ):
        killed: Counter[str] = Counter()
        while killed.total() < CHAOS_KILLS:
            call(run, environment, FLOW_S)
            deadline = time.monotonic() + 60  # then what was killed may not have been the flow
            pause_s = rng.uniform(0.5, 6.0) if killed else LOOK_S
            while killed.total() < CHAOS_KILLS and time.monotonic() < deadline:
                time.sleep(pause_s)
                if not killed:  # while meshes are made
                    if not num_meshes(cold):
                        pause_s = LOOK_S
                        continue
                    assert num_meshes(cold) < OBJECTS
                kind = _next_kind(killed, rng)
                if not kill_one(WORDS[kind], mark, rng):
                    pause_s = LOOK_S
                    continue
                killed[kind] += 1
                if kind == "worker" and not killed["server"]:  # one restart brings both back
                    killed["server"] += kill_one(WORDS["server"], mark, rng)
                pause_s = rng.uniform(0.5, 6.0)
                if killed.total() == CHAOS_KILLS // 2:
                    database.stop()
                    time.sleep(rng.uniform(1.0, 5.0))
                    database.start()
                if kind in ("worker", "server"):
                    stop_served(environment)
                    start_served(environment)
                if kind != "child":
                    break
        if kind not in ("worker", "server"):  # after those there was a fresh start
            stop_served(environment)
            start_served(environment)
        call([*run, "--watch"], environment, FLOW_S)
    assert not wrong
    assert open_dataset(str(out)).digest == expected
    assert verify_dataset(out).problems == []
    assert set(killed) >= set(list(SHARES)[:CHAOS_KILLS]), (
        killed
    )  # a kill is too few to be of each kind
    _nothing_was_made_twice(out)
    wait_until_nobody_is_left(mark)


def _nothing_was_made_twice(out: Path) -> None:
    """A scene gets its row after it was staged for good: one in flight at a kill has none yet, and
    the kill may come between the two, so that at most one row for each kill is missing."""
    rows = [
        json.loads(line)["scene"] for path in (out / "logs").glob("*.jsonl") for line in path.open()
    ]
    assert [scene for scene, number in Counter(rows).items() if number > 1] == []
    assert SCENES - CHAOS_KILLS <= len(rows) <= SCENES
