"""A step that does not end is told once, with the part it is in and the stacks, and goes on."""

import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from train.loop.crew import Crew
from train.watching import watchdog
from train.watching.activity import Activity
from train.watching.settings import WatchSettings
from train.watching.watchdog import Watchdog

ALONE = Crew(device=torch.device("cpu"))


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
        settings, activity, ALONE, tmp_path / "watching", noted=said.append, hung=pytest.fail
    )
    with dog:
        for step in range(1, 5):
            dog.begins("step", step)
        activity.begin("data")
        dog.begins("step", 5)
        sleeping_loader(said, 2)
        dog.begins("step", 6)
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


def test_a_slow_kind_has_its_own_usual_time_and_the_first_steps_have_more(tmp_path: Path) -> None:
    settings = WatchSettings(hang_after_s=1.0, hang_factor=4)
    dog = Watchdog(settings, Activity(), ALONE, tmp_path, noted=pytest.fail, hung=pytest.fail)
    assert dog._limit_s(None) == 5.0
    assert dog._limit_s(0.01) == 1.0
    assert dog._limit_s(3.0) == 12.0


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
    pair = Crew(device=torch.device("cpu"), world_size=2)
    dog = Watchdog(settings, Activity(), pair, tmp_path, noted=said.append, hung=ended.append)
    with dog:
        dog.begins("validation", 7)
        until(lambda: ended)
    assert "the validation after step 7 hangs" in ended[0] and len(ended) == 1
    passed_on = [text for text in said if text.startswith("process 1 of 2: in the loader")]
    assert len(passed_on) == 1 and str(others) in passed_on[0]


def test_a_full_disk_ends_no_watching(tmp_path: Path) -> None:
    said: list[str] = []
    (tmp_path / "watching").write_text("a file where the folder would be")
    settings = WatchSettings(hang_after_s=0.1)
    dog = Watchdog(
        settings, Activity(), ALONE, tmp_path / "watching", noted=said.append, hung=pytest.fail
    )
    with dog:
        dog.begins("step", 1)
        until(lambda: said)
    assert "Stacks" not in said[0]
