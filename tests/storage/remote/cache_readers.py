"""Readers of a cache in processes of their own; what each process imports is kept small."""

from pathlib import Path

from storage.digests import sha256_hex
from storage.remote.shard_cache import ShardCache
from storage.remote.url import RemoteUrl, parse_url

BYTES = 1000


def remote(text: str) -> RemoteUrl:
    url = parse_url(text, what="shard")
    assert isinstance(url, RemoteUrl)
    return url


def digest(name: str) -> str:
    return sha256_hex(name[:1].encode() * BYTES)


def fetch(cache: ShardCache, url: RemoteUrl) -> bytes:
    name = url.root.rpartition("/")[2]
    with cache.open(url, num_bytes=BYTES, sha256=digest(name)) as stream:
        return stream.read()


def read_all(names: list[str], url: str, root: str, start: str) -> None:
    """Read every file many times in another process, in an order of its own."""
    store = ShardCache(Path(root), 3 * BYTES)
    for turn in range(20):
        name = names[(turn * (3 + len(start)) + len(start)) % len(names)]
        assert fetch(store, remote(f"{url}/{name}")) == name[:1].encode() * BYTES


def read_one(url: str, root: str) -> None:
    assert fetch(ShardCache(Path(root), 10**6), remote(url)) == b"a" * BYTES
