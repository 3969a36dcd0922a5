"""The cache: one fetch for many readers, bounded, and nobody loses what he reads."""

import fcntl
import multiprocessing
import os
import signal
import threading
import time
from pathlib import Path

import pytest

from storage.errors import TrilightError
from storage.remote.cache import ShardCache, shard_cache
from storage.remote.url import RemoteUrl
from tests.for_each import for_each
from tests.http_server import Fault, Site
from tests.storage.remote.cache_readers import BYTES, digest, fetch, read_all, read_one, remote
from tests.storage.remote.conftest import until


def put(server: Site, *names: str) -> list[RemoteUrl]:
    """Serve files of BYTES bytes each, that differ."""
    for name in names:
        server.put(name, name[:1].encode() * BYTES)
    return [remote(f"{server.url}/{name}") for name in names]


def gets(server: Site, name: str) -> int:
    return server.gets()[f"/{name}"]


def test_equal_names_of_different_places_do_not_meet(server: Site, cache: Path) -> None:
    urls = put(server, "a/x.tar", "b/x.tar")
    store = ShardCache(cache, 10**6)
    found = [
        store.open(url, num_bytes=None, sha256=digest(name)).read()
        for url, name in zip(urls, "ab", strict=True)
    ]
    assert found == [b"a" * BYTES, b"b" * BYTES]


def test_what_was_not_read_for_longest_goes_first(server: Site, cache: Path) -> None:
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
    assert (gets(server, "a.tar"), gets(server, "b.tar"), gets(server, "c.tar")) == (1, 1, 1)
    fetch(store, b)
    assert gets(server, "b.tar") == 2


def test_what_is_being_read_stays(server: Site, cache: Path) -> None:
    a, b, c = put(server, "a.tar", "b.tar", "c.tar")
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
    assert gets(server, "a.tar") == 2


def test_without_a_hash_a_query_may_tell_two_files_apart(server: Site, cache: Path) -> None:
    """And names in the cache hold no secret."""
    put(server, "a.tar")
    for query in ("key=s3cret1", "key=s3cret2"):
        server.needed_query = query
        url = remote(f"{server.url}/a.tar?{query}")
        shard_cache().open(url, num_bytes=None, sha256=None).close()
    assert len(list(cache.iterdir())) == 2
    assert all(set(path.name) <= set("0123456789abcdef-") for path in cache.iterdir())


def test_threads_fetch_a_shard_once(server: Site, cache: Path) -> None:
    (url,) = put(server, "a.tar")
    server.faults["/a.tar"] = [Fault(stall_after=10)]  # so that all are waiting together
    store = ShardCache(cache, 10**6)
    found: list[bytes] = []
    threads = [threading.Thread(target=lambda: found.append(fetch(store, url))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [b"a" * BYTES] * 8
    assert server.ranges_of("/a.tar") == ["", "bytes=10-"]


def test_processes_share_a_cache_that_is_too_small(server: Site, cache: Path) -> None:
    """Every read is right while the others evict; afterwards the cache keeps its bound."""
    names = [f"{letter}.tar" for letter in "abcdef"]
    put(server, *names)
    context = multiprocessing.get_context("forkserver")
    children = [
        context.Process(target=read_all, args=(names, server.url, str(cache), "x" * number))
        for number in range(2)
    ]
    for child in children:
        child.start()
    for child in children:
        child.join()
    assert [child.exitcode for child in children] == [0, 0]
    fetch(ShardCache(cache, 3 * BYTES), remote(f"{server.url}/a.tar"))
    assert len(list(cache.iterdir())) <= 3 + len(children), "each may add one at the same time"
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


@for_each("text", ["", "0", "much", "nan", "inf"])
def test_a_wrong_size_is_named(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv("TRILIGHT_SHARD_CACHE_GB", text)
    with pytest.raises(TrilightError, match="TRILIGHT_SHARD_CACHE_GB is .*gigabytes above 0"):
        shard_cache()
