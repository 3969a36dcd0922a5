"""Downloads one file of a server or bucket: facts about it, or all of it to a file.

A transfer that breaks off goes on where it stopped, where the server can do that, and ends only
when all announced bytes are there.
"""

from collections.abc import Mapping
from typing import Any, BinaryIO

from storage.errors import Unreadable
from storage.remote.retries import (
    LEAST_BYTES_PER_S,
    WINDOW_S,
    Interrupted,
    Pace,
    TransferFailed,
    with_tries,
)
from storage.remote.url import RemoteUrl, shared_driver, transfer_timeout

PIECE_BYTES = 8 << 20
"""What is asked of a bucket at once, and held in memory."""
_CHUNK_BYTES = 1 << 18
_VERSION_FIELDS = (
    "ETag", "etag", "Last-Modified", "LastModified", "last_modified", "mtime", "updated",
    "md5Hash", "Content-MD5", "blob_id",
)  # fmt: skip
"""Names under which the drivers report the version of a file."""


def facts_of(url: RemoteUrl) -> Mapping[str, Any]:
    """Ask about a file, and return what its driver says, such as `size` where that is known.

    Raises:
        TransferFailed: there is none, it may not be seen, or the server gives no answer.
        TrilightError: the driver's package is missing.
    """
    driver = shared_driver(url)
    info = with_tries(lambda: _fresh_info(driver, url))
    if info.get("type") == "directory":
        raise TransferFailed("download_failed", "is a folder, not a file")
    return info


def _fresh_info(driver: Any, url: RemoteUrl) -> dict[str, Any]:
    """Ask the server itself: one driver caches listings although that is turned off."""
    driver.invalidate_cache()
    return dict(driver.info(url.root))


def version_of(facts: Mapping[str, Any]) -> dict[str, str]:
    """Return of a driver's facts about a file what changes when the file does."""
    return {key: str(facts[key]) for key in _VERSION_FIELDS if facts.get(key)}


def download(url: RemoteUrl, stream: BinaryIO, *, num_bytes: int | None, max_bytes: int) -> None:
    """Write all bytes of a file to an open one, from its start.

    Args:
        url: the file.
        stream: where they go.
        num_bytes: how many there must be, where that is known.
        max_bytes: how many there may be, where it is not.

    It raises TransferFailed as `facts_of`, and where it has another size than `num_bytes`, breaks
    off again and again without moving on, or comes too slowly (storage.remote.retries);
    TrilightError where the driver's package is missing, or the disk is full.
    """
    driver = shared_driver(url)
    fill = _fill_http if url.is_http else _fill_bucket
    pace = Pace(stream.tell)
    expected = _Expected(num_bytes, max_bytes if num_bytes is None else num_bytes, pace)
    with_tries(lambda: fill(driver, url, stream, expected), pace=pace)


class _Expected:
    """Limits of a download: size, version and pace."""

    def __init__(self, exact: int | None, most: int, pace: Pace) -> None:
        self.exact = exact
        self.most = most
        self.pace = pace
        self.version: dict[str, str] | None = None

    def require(self, num_bytes: int, *, is_all: bool = True) -> None:
        """Refuse a file that is announced with another size, or is longer than it may be."""
        if is_all and self.exact not in (None, num_bytes):
            raise TransferFailed("download_failed", f"has {num_bytes} bytes; expected {self.exact}")
        if num_bytes > self.most:
            raise TransferFailed("too_large_bytes", f"is longer than {self.most} bytes")

    def is_same(self, version: Mapping[str, str]) -> bool:
        """Return whether the file is still the one that the bytes so far came from."""
        before = self.version
        self.version = dict(version)
        return before in (None, self.version)


def _fill_bucket(driver: Any, url: RemoteUrl, stream: BinaryIO, expected: _Expected) -> None:
    """Ask for piece after piece; buckets always know the size and always give ranges."""
    facts = _fresh_info(driver, url)
    num_bytes = facts["size"]
    expected.require(num_bytes)
    if not expected.is_same(version_of(facts)):
        _start_over(stream)
    # Drivers that are asynchronous take a limit for the whole answer; the others have one a read.
    most_s = WINDOW_S + PIECE_BYTES / LEAST_BYTES_PER_S
    limit = {"timeout": most_s} if driver.async_impl else {}
    while stream.tell() < num_bytes:
        start = stream.tell()
        end = min(start + PIECE_BYTES, num_bytes)
        piece = driver.cat_file(url.root, start=start, end=end, **limit)
        if len(piece) != end - start:
            raise Interrupted from EOFError(f"got {len(piece)} of {end - start} bytes")
        stream.write(piece)
        if stream.tell() != num_bytes:  # a file that has come whole is not given up
            expected.pace.require()
    if num_bytes > PIECE_BYTES and not expected.is_same(version_of(_fresh_info(driver, url))):
        _start_over(stream, _CHANGED)


def _fill_http(driver: Any, url: RemoteUrl, stream: BinaryIO, expected: _Expected) -> None:
    from fsspec.asyn import sync

    sync(driver.loop, _stream_http, driver, url, stream, expected)


async def _stream_http(driver: Any, url: RemoteUrl, stream: BinaryIO, expected: _Expected) -> None:
    """Read one answer to its end, from where the file stands; from the start if it must be."""
    session = await driver.set_session()
    start = stream.tell()
    headers = {"Range": f"bytes={start}-"} if start else {}
    options = {**driver.kwargs, "headers": headers, "timeout": transfer_timeout()}
    async with session.get(driver.encode_url(url.root), **options) as answer:
        if start and answer.status == 416:  # it has become shorter
            _start_over(stream, _CHANGED)
        if answer.status == 404:
            raise FileNotFoundError(url.display_url)
        answer.raise_for_status()
        if answer.status != 206:
            _start_over(stream)
        elif not answer.headers.get("Content-Range", "").startswith(f"bytes {start}-"):
            _start_over(stream, "the server sent another part than was asked for")
        if not expected.is_same(version_of(answer.headers)) and stream.tell():
            _start_over(stream, _CHANGED)
        total = None
        if answer.content_length is not None:
            expected.require(total := stream.tell() + answer.content_length)
        async for chunk in answer.content.iter_chunked(_CHUNK_BYTES):
            expected.require(stream.tell() + len(chunk), is_all=False)
            stream.write(chunk)
            if stream.tell() != total:
                expected.pace.require()
    if expected.exact not in (None, stream.tell()):
        raise Interrupted from EOFError(f"got {stream.tell()} of {expected.exact} bytes")


def _start_over(stream: BinaryIO, why: str = "") -> None:
    """Drop what has come, and for a reason interrupt the transfer."""
    stream.seek(0)
    stream.truncate()
    if why:
        raise Interrupted from EOFError(why)


_CHANGED = "the file changed while it was read"


def unreadable(url: RemoteUrl, error: TransferFailed) -> Unreadable:
    """Return the user's view of a file that cannot be read."""
    hint = " Public buckets need FSSPEC_S3_ANON=true." if url.scheme == "s3" else ""
    return Unreadable(
        f"{url.what} {url.display_url!r}: cannot be read ({error.message}); expected a file that "
        f"can be reached. Check the URL and your access to it.{hint}"
    )
