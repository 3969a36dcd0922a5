"""Shards over a line that breaks or is slow in every way: whole, or named in bounded time.

From a server of the tests, and from a real one, which is made to fail, stall and die meanwhile.
"""

import os
import shutil
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.shard_places import listed_shards
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from storage.remote import tries
from storage.remote import url as remote_url
from storage.remote.tries import TRIES, Pace, Patience, TransferFailed
from tests.http_server import Fault, Site
from tests.storage.remote.conftest import PATH, SHARD, expected, read, until


def test_a_dataset_is_the_same_through_a_server(server: Site, local: Dataset) -> None:
    remote = open_dataset(f"{server.url}/")
    assert remote.manifest == local.manifest
    assert remote.objects_lock() == local.objects_lock()
    assert remote.failures() == local.failures()
    assert read(server.url) == expected(local)
    with pytest.raises(TrilightError, match="is on a server; expected a local folder"):
        _ = remote.folder


OUTLIVED = {
    "statuses": [Fault(status=500), Fault(status=503), Fault(status=429)],
    "cut": [Fault(cut_after=0), Fault(cut_after=5000), Fault(cut_after=1)],
    "stalled": [Fault(stall_after=3000)],
    "changed bytes": [Fault(flip=True)],
    "another part": [Fault(cut_after=4000), Fault(other_part=True)],
    "cut often": [Fault(cut_after=100)] * 12,
    "lengths unsaid": [Fault(cut_after=4000, no_length=True), Fault(no_length=True)],
}


@pytest.mark.parametrize("faults", OUTLIVED.values(), ids=OUTLIVED)
@pytest.mark.parametrize("ranges", [True, False])
def test_what_passes_by_itself_is_outlived(
    server: Site,
    local: Dataset,
    cache: Path,
    monkeypatch: pytest.MonkeyPatch,
    faults: list[Fault],
    ranges: bool,
) -> None:
    if len(faults) > 4 and not ranges:
        pytest.skip("without ranges, a line that always breaks gets nowhere")
    monkeypatch.setattr(tries, "PATIENCE", Patience(least_bytes_per_s=0.0))  # of a busy machine
    server.faults[PATH], server.ranges = list(faults), ranges
    assert read(server.url) == expected(local)
    assert not server.faults[PATH]
    (kept,) = cache.iterdir()
    assert kept.read_bytes() == (local.folder.root / SHARD).read_bytes()


def test_a_transfer_goes_on_where_it_broke(server: Site, local: Dataset) -> None:
    size = local.shards_of("train")[0].num_bytes
    server.faults[PATH] = [Fault(cut_after=size // 2), Fault(cut_after=size // 4)]
    read(server.url)
    assert server.ranges_of(PATH) == ["", f"bytes={size // 2}-", f"bytes={size // 2 + size // 4}-"]
    beside = (local.folder.root / "manifest.json").stat().st_size
    assert server.sent == size + beside, "no byte of the shard came twice"


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (Fault(status=403), "cannot be read .*status 403"),
        (Fault(status=404), "cannot be read .*no such file"),
        (Fault(status=500), "cannot be read .*status 500"),
        (Fault(cut_after=0), "cannot be read .*Payload"),
        (Fault(flip=True), "not those of the manifest .sha256 differs, 2 times"),
    ],
)
def test_what_stays_broken_is_named(server: Site, cache: Path, fault: Fault, message: str) -> None:
    server.always[PATH] = fault
    server.needed_query = "key=s3cret"
    with pytest.raises(TrilightError, match=message) as caught:
        read(f"{server.url.replace('//', '//ada:pa55@')}?key=s3cret")
    text = str(caught.value)
    assert SHARD in text and "expected" in text and "\n" not in text
    assert "s3cret" not in text and "ada" not in text and "pa55" not in text
    assert not list(cache.iterdir()), "nothing is left, under any name"
    assert server.gets()[PATH] == {403: 1, 404: 1, 500: 5}.get(fault.status, 2 if fault.flip else 5)


@pytest.mark.usefixtures("cache")
def test_advice_to_delete_is_given_for_what_was_read_and_found_wrong_only(
    server: Site, local: Dataset
) -> None:
    server.always[PATH] = Fault(no_length=True)
    assert verify_dataset(server.url).problems == []
    unread = verify_dataset(server.url, fast=True)
    assert unread.problems == [f"{SHARD}: its server states no size"]
    server.always[PATH] = Fault(status=500)
    slow = verify_dataset(server.url)
    assert len(slow.problems) == 1 and "cannot be read" in slow.problems[0]
    assert [*unread.bad_shards, *slow.bad_shards] == []
    server.always[PATH] = Fault(flip=True)
    assert verify_dataset(server.url).bad_shards == [SHARD]
    del server.always[PATH]
    (local.folder.root / SHARD).unlink()
    assert verify_dataset(server.url).problems == [f"{SHARD}: missing"]


def test_a_shard_of_another_size_is_named_at_once(server: Site, local: Dataset) -> None:
    path = local.folder.root / SHARD
    content = path.read_bytes()
    path.write_bytes(content + bytes(512))
    with pytest.raises(TrilightError, match=rf"has {len(content) + 512} bytes; expected"):
        read(server.url)
    assert server.gets()[PATH] == 1


def test_a_file_that_changes_meanwhile_is_read_from_the_start(server: Site, local: Dataset) -> None:
    """Without a manifest there is no hash that would tell, but the server names the version."""
    path = local.folder.root / SHARD
    other = (local.folder.root / "train-000001.tar").read_bytes()
    server.faults[PATH] = [Fault(stall_after=4000)]
    (place,) = listed_shards([f"{server.url}/{SHARD}"])
    assert PATH not in server.gets()

    def change() -> None:
        while PATH not in server.gets():
            pass
        fresh = path.with_suffix(".fresh")
        fresh.write_bytes(other)
        fresh.replace(path)  # at once: the server must not find half of it

    changer = threading.Thread(target=change)
    changer.start()
    with place.open() as stream:
        assert stream.read() == other
    changer.join()


def test_a_manifest_that_is_not_there_is_named(server: Site) -> None:
    with pytest.raises(TrilightError, match=r"no manifest\.json here"):
        open_dataset(f"{server.url}/nowhere")
    server.needed_query = "key"
    with pytest.raises(TrilightError, match=r"manifest\.json.* cannot be read .*status 403"):
        open_dataset(server.url)
    with pytest.raises(TrilightError, match="cannot be read .*Connect"):
        open_dataset("http://127.0.0.1:1/data")


def test_a_cache_that_cannot_be_written_is_named(
    server: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "file"))
    with pytest.raises(TrilightError, match="is no folder; expected one"):
        read(server.url)


def patience(monkeypatch: pytest.MonkeyPatch, **limits: float) -> None:
    monkeypatch.setattr(tries, "PATIENCE", Patience(**limits))


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


def test_a_slow_steady_link_is_waited_for(
    server: Site, local: Dataset, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Many windows long, and broken off more often than there are tries."""
    size = local.shards_of("train")[0].num_bytes
    patience(monkeypatch, window_s=0.25, least_bytes_per_s=10.0)
    step = size // 40
    server.faults[PATH] = [Fault(cut_after=step, trickle=(step // 4, 0.02))] * (2 * TRIES)
    server.faults[PATH] += [Fault(trickle=(step, 0.02))]
    assert read(server.url)
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


NGINX = shutil.which("nginx", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin")

CONFIG = """
daemon off; master_process off; pid {here}/pid; error_log {here}/error.log;
events {{}}
http {{
  log_format short '$request_method $uri $status $http_range $body_bytes_sent';
  access_log {here}/access.log short;
  client_body_temp_path {here}/t; proxy_temp_path {here}/t; fastcgi_temp_path {here}/t;
  uwsgi_temp_path {here}/t; scgi_temp_path {here}/t;
  server {{
    listen 127.0.0.1:{port}; root {root};
    location / {{
      if (-f {here}/slow) {{ set $limit_rate 4000; }}
    }}
  }}
}}
"""


class Nginx:
    """A server that can be killed and started again on the same port."""

    def __init__(self, here: Path, root: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.here = here
        self.url = f"http://127.0.0.1:{self.port}"
        here.mkdir()
        (here / "nginx.conf").write_text(CONFIG.format(here=here, root=root, port=self.port))

    def start(self) -> None:
        command = [str(NGINX), "-p", str(self.here), "-c", str(self.here / "nginx.conf")]
        self.process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        until(lambda: socket.socket().connect_ex(("127.0.0.1", self.port)) == 0)

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def requests(self) -> list[list[str]]:
        """Return method, file, status, range and bytes of what was asked."""
        return [line.split() for line in (self.here / "access.log").read_text().splitlines()]


@pytest.fixture
def nginx(
    local: Dataset, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Nginx]:
    if NGINX is None:
        pytest.skip("no nginx here; install the distribution's package (Debian: nginx-light)")
    monkeypatch.setattr(tries, "PAUSE_S", 0.2)
    monkeypatch.setattr(remote_url, "_SILENCE_S", 1.0)
    remote_url._driver_of.cache_clear()
    server = Nginx(tmp_path / "nginx", local.folder.root)
    server.start()
    try:
        yield server
    finally:
        server.kill()
        remote_url._driver_of.cache_clear()


def start_reading(url: str) -> tuple[threading.Thread, list[dict[str, bytes]]]:
    found: list[dict[str, bytes]] = []
    thread = threading.Thread(target=lambda: found.extend(read(url)))
    thread.start()
    return thread, found


def test_a_server_that_dies_and_comes_back_goes_on_where_it_was(
    nginx: Nginx, local: Dataset, cache: Path
) -> None:
    (nginx.here / "slow").touch()
    thread, found = start_reading(nginx.url)
    until(lambda: any(path.stat().st_size > 2000 for path in cache.glob("*.part")))
    nginx.kill()
    (nginx.here / "slow").unlink()
    nginx.start()
    thread.join()
    assert found == expected(local)
    last = [row for row in nginx.requests() if row[1] == f"/{SHARD}"][-1]
    assert last[2] == "206" and last[3].startswith("bytes=") and last[3] != "bytes=0-"
    assert int(last[4]) < local.shards_of("train")[0].num_bytes
