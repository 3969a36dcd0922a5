"""Servers that stall or trickle are left in bounded time; slow steady ones are waited for."""

import time
from pathlib import Path

import pytest

from storage.dataset.dataset import Dataset, open_dataset
from storage.errors import TrilightError
from storage.remote import tries
from storage.remote.tries import TRIES, Pace, Patience, TransferFailed
from tests.http_server import Fault, Site

SHARD = "train-000000.tar"
PATH = f"/{SHARD}"


def patience(monkeypatch: pytest.MonkeyPatch, **limits: float) -> None:
    monkeypatch.setattr(tries, "PATIENCE", Patience(**limits))


def read(url: str) -> int:
    dataset = open_dataset(url)
    return len(list(dataset.read_shard(dataset.shards_of("train")[0])))


def test_a_server_that_trickles_is_left(
    server: Site, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One byte every 20 ms is never silent, and moves on at every look."""
    patience(monkeypatch, window_s=0.5, least_bytes_per_s=1000.0)
    server.always[PATH] = Fault(trickle=(1, 0.02))
    begun_s = time.monotonic()
    with pytest.raises(TrilightError, match=r"too slow, \d+ bytes in .* at least 1000 a second"):
        read(server.url)
    assert time.monotonic() - begun_s < 30, "of a file that would take minutes"
    assert server.gets()[PATH] == 1
    assert not list(cache.iterdir())


def test_a_server_that_stalls_after_a_few_bytes_is_left(
    server: Site, local: Dataset, cache: Path
) -> None:
    """Each answer moves on by 100 bytes: that is no reason to count the tries anew."""
    server.always[PATH] = Fault(stall_after=100)
    assert local.shards_of("train")[0].num_bytes > 100 * TRIES
    with pytest.raises(TrilightError, match=r"cannot be read \(no answer in time\)"):
        read(server.url)
    assert server.gets()[PATH] == TRIES


def test_a_file_that_takes_too_long_altogether_is_left(
    server: Site, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    patience(monkeypatch, file_s=0.5, least_bytes_per_s=1.0)
    server.always[PATH] = Fault(trickle=(10, 0.02))
    with pytest.raises(TrilightError, match="it did not come within 0 s"):
        read(server.url)


def test_a_slow_steady_link_is_waited_for(
    server: Site, local: Dataset, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Many windows long, and broken off more often than there are tries."""
    size = local.shards_of("train")[0].num_bytes
    patience(monkeypatch, window_s=0.25, least_bytes_per_s=10.0)
    step = size // 40
    server.faults[PATH] = [Fault(cut_after=step, trickle=(step // 4, 0.02))] * (2 * TRIES)
    server.faults[PATH] += [Fault(trickle=(step, 0.02))]
    assert read(server.url) > 0
    assert server.gets()[PATH] == 2 * TRIES + 1


class Line:
    """A transfer of which a test says when how much has come."""

    def __init__(self) -> None:
        self.now_s, self.reached = 0.0, 0
        self.pace = Pace(lambda: self.reached, lambda: self.now_s)

    def passes(self, seconds: float, num_bytes: int) -> None:
        self.now_s += seconds
        self.reached += num_bytes


def test_the_limits_that_hold_for_users() -> None:
    """10 kB/s pass, 9 do not; a day is the end; 100 bytes a minute are no progress, 1 MB is."""
    for rate, ends in ((10_000, False), (9_000, True)):
        line = Line()
        for _ in range(601):
            line.passes(1.0, rate)
            if ends and line.now_s >= 300:
                with pytest.raises(TransferFailed, match="too slow, 2700000 bytes in 300 s"):
                    line.pace.require()
                break
            line.pace.require()
    line = Line()
    line.passes(60.0, 100)
    assert not line.pace.has_moved_on()
    line.passes(60.0, 1_000_000)
    assert line.pace.has_moved_on()
    line.passes(86_400.0, 10**10)
    with pytest.raises(TransferFailed, match="did not come within 86400 s"):
        line.pace.require()


def test_a_beginning_anew_is_no_progress() -> None:
    line = Line()
    line.passes(1.0, 10**6)
    assert line.pace.has_moved_on()
    line.passes(1.0, -(10**6))
    assert not line.pace.has_moved_on()
    line.passes(300.0, 0)
    with pytest.raises(TransferFailed, match="too slow, 0 bytes"):
        line.pace.require()
