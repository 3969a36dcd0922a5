"""The cache: one fetch for many readers, bounded, and nobody loses what he reads.

Shards over a line that breaks or is slow in every way: whole, or named in bounded time, from a
server of the tests, which is made to fail and stall meanwhile. And what is shown of a URL: enough
to find the place, nothing that opens it.
"""

import errno
import fcntl
import multiprocessing
import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.shard_set import listed_shards
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from storage.remote import transfers
from storage.remote.shard_cache import ShardCache, shard_cache
from storage.remote.transfers import TRIES, Pace, TransferFailed, with_tries
from storage.remote.url import RemoteUrl, public_text, safe_text, safe_url
from tests.for_each import case
from tests.http_server import Fault, Site
from tests.storage.remote.cache_readers import BYTES, digest, fetch, read_all, read_one, remote
from tests.storage.remote.conftest import PATH, SHARD, expected, read, until


def put(server: Site, *names: str) -> list[RemoteUrl]:
    """Serve files of BYTES bytes each, that differ."""
    for name in names:
        server.put(name, name[:1].encode() * BYTES)
    return [remote(f"{server.url}/{name}") for name in names]


def test_equal_names_of_different_places_do_not_meet(server: Site, cache: Path) -> None:
    urls = put(server, "a/x.tar", "b/x.tar")
    store = ShardCache(cache, 10**6)
    found = [
        store.open(url, num_bytes=None, sha256=digest(name)).read()
        for url, name in zip(urls, "ab", strict=True)
    ]
    assert found == [b"a" * BYTES, b"b" * BYTES]


def test_what_was_not_read_for_longest_goes_first_and_what_is_being_read_stays(
    server: Site, cache: Path
) -> None:
    a, b, c, d = put(server, "a.tar", "b.tar", "c.tar", "d.tar")
    store = ShardCache(cache, 3 * BYTES)
    for number, url in enumerate((a, b, c, a)):
        fetch(store, url)
        for path in cache.iterdir():  # clocks of files are coarse
            os.utime(path, ns=(path.stat().st_atime_ns, path.stat().st_mtime_ns - 10**9))
        assert len(list(cache.iterdir())) <= 3, number
    fetch(store, d)
    assert len(list(cache.iterdir())) == 3
    fetch(store, a)
    fetch(store, c)
    assert [server.gets()[f"/{name}.tar"] for name in "abc"] == [1, 1, 1]
    fetch(store, b)
    assert server.gets()["/b.tar"] == 2
    store = ShardCache(cache, BYTES)
    with store.open(a, num_bytes=BYTES, sha256=digest("a")) as stream:
        fetch(store, b)
        fetch(store, c)
        assert {path.read_bytes()[:1] for path in cache.iterdir()} == {b"a", b"c"}
        assert stream.read() == b"a" * BYTES
    fetch(store, b)
    assert [path.read_bytes()[:1] for path in cache.iterdir()] == [b"b"]


def test_without_a_hash_the_version_tells(server: Site, cache: Path) -> None:
    (url,) = put(server, "a.tar")
    store = ShardCache(cache, 10**6)
    for content in (b"a" * BYTES, b"a" * BYTES, b"z" * BYTES):
        server.put("a.tar", content)
        with store.open(url, num_bytes=None, sha256=None) as stream:
            assert stream.read() == content
    assert server.gets()["/a.tar"] == 2


def test_without_a_hash_a_query_may_tell_two_files_apart(server: Site, cache: Path) -> None:
    """And names in the cache hold no secret."""
    put(server, "a.tar")
    for query in ("key=s3cret1", "key=s3cret2"):
        server.needed_query = query
        url = remote(f"{server.url}/a.tar?{query}")
        shard_cache().open(url, num_bytes=None, sha256=None).close()
    assert len(list(cache.iterdir())) == 2
    assert all(set(path.name) <= set("0123456789abcdef-") for path in cache.iterdir())


def test_threads_fetch_a_shard_once_and_processes_share_a_cache_that_is_too_small(
    server: Site, cache: Path
) -> None:
    (url,) = put(server, "a.tar")
    server.faults["/a.tar"] = [Fault(stall_after=10)]  # so that all are waiting together
    store = ShardCache(cache, 10**6)
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda _: fetch(store, url), range(8)))
    assert found == [b"a" * BYTES] * 8
    assert server.ranges_of("/a.tar") == ["", "bytes=10-"]
    # every read is right while the others evict; afterwards the cache keeps its bound
    names = [f"{letter}.tar" for letter in "abcdef"]
    put(server, *names)
    with multiprocessing.get_context("forkserver").Pool(2) as children:
        orders = [(names, server.url, str(cache), "x" * number) for number in range(2)]
        children.starmap(read_all, orders, chunksize=1)  # raises what they raise
    fetch(ShardCache(cache, 3 * BYTES), remote(f"{server.url}/a.tar"))
    assert len(list(cache.iterdir())) <= 3 + 2, "each may add one at the same time"
    assert all(len(path.read_bytes()) == BYTES for path in cache.iterdir())


def test_a_fetcher_that_was_killed_holds_nobody_up(server: Site, cache: Path) -> None:
    (url,) = put(server, "a.tar")
    store = ShardCache(cache, 10**6)
    cache.mkdir(parents=True)
    leftover = cache / "0-0.77.part"
    leftover.write_bytes(b"half")
    old = time.time() - 2 * 86400
    os.utime(leftover, (old, old))
    assert fetch(store, url) == b"a" * BYTES
    assert not leftover.exists()
    locks = list(cache.with_name("shards-locks").iterdir())
    for lock in locks:
        with lock.open() as stream:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)  # nobody holds it


def test_a_kill_in_the_middle_of_a_download_leaves_nothing_wrong(server: Site, cache: Path) -> None:
    """While another process waits for the same shard: it takes over, and gets all of it."""
    put(server, "a.tar")
    server.faults["/a.tar"] = [Fault(stall_after=BYTES // 2)]
    context = multiprocessing.get_context("forkserver")
    arguments = (f"{server.url}/a.tar", str(cache))
    first, second = (context.Process(target=read_one, args=arguments) for _ in range(2))
    first.start()
    until(lambda: server.sent == BYTES // 2)
    second.start()
    until(lambda: _waits_for_a_lock(second.pid))
    assert not [path for path in cache.iterdir() if path.suffix != ".part"]
    first.kill()
    first.join()
    second.join()
    assert (first.exitcode, second.exitcode) == (-signal.SIGKILL, 0)
    (kept,) = [path for path in cache.iterdir() if path.suffix != ".part"]
    assert kept.read_bytes() == b"a" * BYTES
    assert server.ranges_of("/a.tar") == ["", ""], "what a killed process has left is not trusted"


def _waits_for_a_lock(process: int | None) -> bool:
    waiting = (line.split() for line in Path("/proc/locks").read_text().splitlines())
    return any(row[1] == "->" and int(row[5]) == process for row in waiting)


def test_a_wrong_size_and_a_place_that_cannot_be_written_are_named(
    server: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for text in ("", "0", "much", "nan", "inf"):
        monkeypatch.setenv("TRILIGHT_SHARD_CACHE_GB", text)
        with pytest.raises(TrilightError, match="TRILIGHT_SHARD_CACHE_GB is .*gigabytes above 0"):
            shard_cache()
    monkeypatch.delenv("TRILIGHT_SHARD_CACHE_GB")
    (tmp_path / "file").touch()
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "file"))
    with pytest.raises(TrilightError, match="is no folder; expected one"):
        read(server.url)


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
    monkeypatch.setattr(transfers, "LEAST_BYTES_PER_S", 0.0)  # of a busy machine
    server.faults[PATH], server.ranges = list(faults), ranges
    assert read(server.url) == expected(local)
    assert not server.faults[PATH]
    (kept,) = cache.iterdir()
    assert kept.read_bytes() == (local.folder.root / SHARD).read_bytes()


def test_a_dataset_is_the_same_through_a_server_and_goes_on_where_it_broke(
    server: Site, local: Dataset
) -> None:
    size = local.shards_of("train")[0].num_bytes
    server.faults[PATH] = [Fault(cut_after=size // 2), Fault(cut_after=size // 4)]
    read(server.url)
    assert server.ranges_of(PATH) == ["", f"bytes={size // 2}-", f"bytes={size // 2 + size // 4}-"]
    beside = (local.folder.root / "manifest.json").stat().st_size
    assert server.sent == size + beside, "no byte of the shard came twice"
    remote = open_dataset(f"{server.url}/")
    assert remote.manifest == local.manifest
    assert remote.objects_lock() == local.objects_lock()
    assert remote.failures() == local.failures()
    assert read(server.url) == expected(local)
    with pytest.raises(TrilightError, match="is on a server; expected a local folder"):
        _ = remote.folder


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
def test_advice_to_delete_is_given_only_for_what_was_read(server: Site, local: Dataset) -> None:
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
        until(lambda: PATH in server.gets())
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


def patience(monkeypatch: pytest.MonkeyPatch, **limits: float) -> None:
    for name, value in limits.items():
        monkeypatch.setattr(transfers, name.upper(), value)


def test_a_server_that_stalls_after_a_few_bytes_or_trickles_is_left(
    server: Site, local: Dataset, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each answer moves on by 100 bytes: that is no reason to count the tries anew.

    One byte every 20 ms is never silent, and moves on at every look.
    """
    server.always[PATH] = Fault(stall_after=100)
    assert local.shards_of("train")[0].num_bytes > 100 * TRIES
    with pytest.raises(TrilightError, match=r"cannot be read \(no answer in time\)"):
        read(server.url)
    assert server.gets()[PATH] == TRIES
    patience(monkeypatch, window_s=0.5, least_bytes_per_s=1000.0)
    server.always[PATH] = Fault(trickle=(1, 0.02))
    begun_s = time.monotonic()
    with pytest.raises(TrilightError, match=r"too slow, \d+ bytes in .* at least 1000 a second"):
        read(server.url)
    assert time.monotonic() - begun_s < 30, "of a file that would take minutes"
    assert server.gets()[PATH] == TRIES + 1
    assert not list(cache.iterdir())


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
    line.passes(1.0, -(10**6))  # it begins anew
    assert not line.pace.has_moved_on()
    line.passes(300.0, 0)
    with pytest.raises(TransferFailed, match="too slow, 100 bytes in 421 s"):
        line.pace.require()
    line.passes(86_400.0, 10**10)
    with pytest.raises(TransferFailed, match="did not come within 86400 s"):
        line.pace.require()


def test_a_server_that_is_away_for_a_moment_is_waited_for(cache: Path) -> None:
    """As one that is killed and started again: nothing answers at its port meanwhile."""
    refused = [ConnectionRefusedError(errno.ECONNREFUSED, "refused")] * (TRIES - 1)

    def read_once() -> str:
        if refused:
            raise refused.pop()
        return "read"

    assert with_tries(read_once) == "read"


SHOWN = {
    "https://host/a/b.glb": "https://host/a/b.glb",
    "http://[::1]:8000/a": "http://[::1]:8000/a",
    "https://ada:s3@cret@host/a": "https://host/a",
    "https://host/a?token=s3cret": "https://host/a",
    "https://host/a#s3cret": "https://host/a",
    "https://ada:s3cret/x@host/a": "https://...",
    "https://ada:s3cret?x@host/a": "https://...",
    "https://ada:s3cret\\x@host/a": "https://...",
    "s3://key:s3cret@bucket/a": "s3://bucket/a",
    "https://host/pkg@1.0/a": "https://host/pkg@1.0/a",
    "https://[broken/a?s3cret": "https://[broken/a",
    "/home folder/a?b": "/home folder/a?b",
    "": "",
}
PUBLISHED = {
    "https://ada:s3cret@host/a?id=7#top": "https://host/a?id=7#top",
    "see https://ada:s3cret@host/a, and more": "see https://host/a, and more",
    "https://host/a?X-Amz-Signature=s3cret&id=7": "https://host/a",
    "https://host/a?id=7&sig=s3cret": "https://host/a",
    "https://host/a#access_token=s3cret": "https://host/a",
    "https://ada:s3cret?x@host/a": "https://...",
    "Ada Lovelace": "Ada Lovelace",
}


def test_what_is_shown_or_published_of_a_url_opens_nothing() -> None:
    for url, shown in SHOWN.items():
        with case(url):
            assert safe_url(url) == shown
            assert safe_url(shown) == shown
    for text, published in PUBLISHED.items():
        with case(text):
            assert public_text(text) == published


def test_messages_lose_their_secrets() -> None:
    for text in (
        "404, message='Not Found', url='https://ada:s3cret@host/a?sig=s3cret'",
        'cannot open "https://ada:s3cret@host/a", giving up',
        "two: https://a:s3cret@b/c and s3://d:s3cret@e/f?s3cret",
        "Authorization: Bearer s3cret.s3cret",
        "header 'x-amz-security-token': s3cret",
        "password = s3cret",
        "AccessKeyId is AKIAs3crets3cret, refused",
        "hf_s3crets3crets3crets3cret is not valid",
    ):
        with case(text):
            shown = safe_text(text)
            assert "s3cret" not in shown and "ada" not in shown
    for plain in ("Connection reset by peer", "expected 12 bytes, got 7", "https://host/a: gone"):
        assert safe_text(plain) == plain
