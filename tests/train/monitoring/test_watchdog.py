"""A step that does not end is told once, with the part it is in and the stacks, and goes on.

Two real processes, of which one is slow and once very slow, which this file is when it is run; and
what a row of the log gets.
"""

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from storage.dataset.dataset import Dataset
from tests.conftest import ROOT
from tests.train.kit import ALONE, CPU, tiny_run, trained
from train.data import stream
from train.data.scenes import TrainingScene
from train.folder import RunFolder
from train.loop.distributed import DistributedContext, join_processes
from train.monitoring import spikes, watchdog
from train.monitoring.activity import PHASES, Activity
from train.monitoring.rows import read_rows
from train.monitoring.settings import WatchSettings
from train.monitoring.watchdog import Watchdog
from train.progress import TrainProgress
from train.run import train_run


def until(done: Callable[[], object]) -> None:
    """Wait for another thread; a minute is long enough on any machine."""
    end = time.monotonic() + 60
    while not done():
        assert time.monotonic() < end
        time.sleep(0.01)


def sleeping_loader(said: list[str], count: int) -> None:
    """Stands for a read that hangs."""
    until(lambda: len(said) >= count)


def test_a_loader_that_sleeps_is_named_with_its_stack(tmp_path: Path) -> None:
    said: list[str] = []
    settings = WatchSettings(hang_after_s=0.1, hang_factor=2)
    activity = Activity()
    dog = Watchdog(
        settings, activity, ALONE, tmp_path / "watching", note=said.append, report_hang=pytest.fail
    )
    with dog:
        for step in range(1, 5):
            dog.begin("step", step)
        activity.begin("data")
        dog.begin("step", 5)
        sleeping_loader(said, 2)
        dog.begin("step", 6)
        until(lambda: "step 5 went on after all" in said)
    first, again = said[0], said[1]
    assert first.startswith("process 0 of 1: step 5 has taken ")
    assert "s is usual; for " in first and "it has been in: waiting for data" in first
    assert again != first, "told again later, with the time of then"
    (path,) = (tmp_path / "watching").iterdir()
    assert path.name == "hang-step-000000005-rank-0.txt" and str(path) in first
    text = path.read_text()
    assert "sleeping_loader" in text and "watchdog" in text, "stacks of all threads"
    assert text.count("process 0 of 1") == 2


def test_words_of_other_processes_are_passed_on_and_the_run_stops_if_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watchdog, "GRACE_S", 0.3)
    said: list[str] = []
    ended: list[str] = []
    settings = WatchSettings(hang_after_s=0.1, on_hang="stop")
    others = tmp_path / "hang-step-000000007-rank-1.txt"
    old = tmp_path / "hang-step-000000007-rank-2.txt"
    for path in (others, old):
        path.write_text("process 1 of 2: in the loader\n\nThread 1\n")
    os.utime(others, (time.time() + 60, time.time() + 60))  # written while it hangs
    os.utime(old, (0, 0))  # of an earlier call
    pair = DistributedContext(device=CPU, world_size=2)
    dog = Watchdog(settings, Activity(), pair, tmp_path, note=said.append, report_hang=ended.append)
    with dog:
        dog.begin("validation", 7)
        until(lambda: ended)
    assert "the validation after step 7 hangs" in ended[0] and len(ended) == 1
    passed_on = [text for text in said if text.startswith("process 1 of 2: in the loader")]
    assert len(passed_on) == 1 and str(others) in passed_on[0]


def test_a_full_disk_ends_no_watching(tmp_path: Path) -> None:
    said: list[str] = []
    (tmp_path / "watching").write_text("a file where the folder would be")
    settings = WatchSettings(hang_after_s=0.1)
    dog = Watchdog(
        settings,
        Activity(),
        ALONE,
        tmp_path / "watching",
        note=said.append,
        report_hang=pytest.fail,
    )
    with dog:
        dog.begin("step", 1)
        until(lambda: said)
    assert "Stacks" not in said[0]


def test_a_row_tells_parts_memory_and_layers_and_spikes_name_their_scenes(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Spikes by a bound so low that there are some."""
    monkeypatch.setattr(spikes, "LEAST_REMEMBERED", 2)
    monkeypatch.setattr(spikes, "LEAST_DEVIATION", 0.0)
    watched = WatchSettings(spike_bound=1.0)
    result = trained(tiny_run(), dataset, tmp_path, watched=watched)
    rows = read_rows(result.folder.metrics)
    windows = [row for row in rows if "loss" in row]
    assert [row["step"] for row in windows] == [2, 4, 6, 8, 10, 12]
    for row in windows:
        assert set(row["time_s"]) == set(PHASES)
        assert row["time_s"]["forward"] > 0 < row["time_s"]["backward"]
        assert row["memory_mb"].get("process", 100) > 50
        assert "decoder.head" in row["layers"] and "own_s" not in row
    # a window holds the validation and the saving that came before its first step
    assert windows[2]["time_s"]["validation"] > 0 < windows[2]["time_s"]["saving"]
    assert windows[1]["time_s"]["validation"] == 0
    found = [row for row in rows if "spike" in row]
    assert found
    for row in found:
        assert len(row["spike"]["keys"]) == 3 and row["spike"]["value"] > row["spike"]["bound"]
    assert read_rows(result.folder.notes)[0]["text"] == "began on cpu, 1 process"


@pytest.mark.slow("training")
def test_of_two_processes_the_slow_one_and_the_hanging_one_are_named(
    dataset: Dataset, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    words = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    words += ["-m", "tests.train.monitoring.test_watchdog", str(dataset.folder.root), str(out)]
    own = {"OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"}
    done = subprocess.run(
        words, cwd=ROOT, env=os.environ | own, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "process 1 of 2 is the slow one" in done.stdout
    first = r"process 0 of 2: step \d+ has taken .* exchange with the other processes"
    second = r"process 1 of 2: step \d+ has taken .* waiting for data\. Stacks"
    assert re.search(first, done.stdout), done.stdout
    assert re.search(second, done.stdout), done.stdout
    assert "went on after all" in done.stdout
    stacks = [path.read_text() for path in RunFolder(out).monitoring.glob("hang-*-rank-1.txt")]
    assert any("test_watchdog.py" in text and "sleeping" in text for text in stacks)
    rows = [row for row in read_rows(RunFolder(out).metrics) if "loss" in row]
    fast, slow = (sum(row["own_s"][rank] for row in rows) for rank in range(2))
    assert slow > fast, "seen by their own time, for that of a step is the same"
    assert any(row["time_s"]["exchange"] > 1 for row in rows), "the fast one waits in the exchange"
    texts = [note["text"] for note in read_rows(RunFolder(out).notes)]
    assert "began on cpu, 2 processes" in texts


SLEEP_S = 4.0


class Said(TrainProgress):
    """Prints notes."""

    def note(self, text: str) -> None:
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()


def slow_from(crew: DistributedContext) -> None:
    """Let the second process's loader sleep a little at each scene, and once for long."""
    made, count = stream._SceneMaker.scene, 0

    def sleeping(maker: stream._SceneMaker, place: stream.Visit) -> TrainingScene:
        nonlocal count
        count += 1
        time.sleep(SLEEP_S if count == 12 else 0.2)
        return made(maker, place)

    if not crew.is_first:
        setattr(stream._SceneMaker, "scene", sleeping)  # noqa: B010


def main(data: str, out: Path) -> None:
    settings = tiny_run(
        scenes_per_step=2, num_steps=16, log_every=4, validate_every=16, checkpoint_every=16
    )
    stream.PREFETCHED_SCENES = 1
    with join_processes("cpu") as crew:
        slow_from(crew)
        watched = WatchSettings(hang_after_s=1.0, hang_factor=2.0)
        train_run(
            settings, data=[data], out=out, dist_context=crew, watched=watched, progress=Said()
        )


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
