"""Transfers of files of servers and buckets: downloads, retries, the least rate, safe messages.

A transfer that breaks off goes on where it stopped, where the server can do that, and ends only
when all announced bytes are there.
"""

import errno
import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO, TypeVar

from storage.errors import EnvironmentFailure, TrilightError, Unreadable
from storage.remote.url import RemoteUrl, printable, safe_text, shared_driver, transfer_timeout

Result = TypeVar("Result")

TRIES = 5
"""Number of tries in a row without progress at LEAST_BYTES_PER_S."""
PAUSE_S = 0.5
"""Pause before the second try; doubled before each further one, up to MAX_PAUSE_S."""
MAX_PAUSE_S = 20.0
LEAST_BYTES_PER_S = 10_000.0
"""Mean rate below which a transfer ends: a shard of 100 MB would take three hours. The slowest
links that people work over, mobile ones at the edge of a cell, give twice that."""
WINDOW_S = 300.0
"""Seconds over which the mean is taken; a link may be gone for nearly as long."""
FILE_S = 86_400.0
"""Seconds for all of one file, tries and restarts included: a day, in which the least
rate brings 864 MB."""
_MOST_TRIES = 1000
"""Maximum number of tries of a transfer that progresses a little each time."""
_MAX_MESSAGE = 200
_MAY_PASS_STATUS = (408, 409, 425, 429)
"""HTTP statuses worth a retry; 409: concurrent creation, the loser retries."""


class TransferFailed(Exception):
    """A permanent transfer failure: a stable code in snake_case, and a sentence without secrets."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(reason, message)
        self.reason = reason
        self.message = message


def with_tries(function: Callable[[], Result], *, pace: "Pace | None" = None) -> Result:
    """Retry a function after transient errors, with growing pauses.

    The pause before try n is PAUSE_S 2^(n-1), at most MAX_PAUSE_S, times a random factor between a
    half and one and a half, so that many readers of one server do not come back all at once.

    Args:
        function: what to try.
        pace: of the file that is on its way; where it came at the least rate since the last error,
            the tries are counted again from 1.

    It raises TransferFailed, and TrilightError, as the function; `download_failed` for any other
    exception, or a file that comes too slowly; an EnvironmentFailure where the disk is full.
    """
    from tenacity import Retrying  # slow to import

    number = 0

    def is_worth_a_try(state: Any) -> bool:
        nonlocal number
        error = state.outcome.exception()
        if isinstance(error, TransferFailed | TrilightError) or not isinstance(error, Exception):
            return False
        cause = root_error(error)
        if isinstance(cause, OSError) and cause.errno in (errno.ENOSPC, errno.EDQUOT):
            raise EnvironmentFailure(
                "the disk is full. What was finished is safe: free some space and run the same "
                "command again."
            ) from error
        number = 1 if pace is not None and pace.has_moved_on() else number + 1
        if number == TRIES or not may_pass(cause):
            raise TransferFailed("download_failed", describe(cause)) from error
        if pace is not None:
            pace.require()
        if state.attempt_number == _MOST_TRIES:
            raise TransferFailed("download_failed", f"it was interrupted {_MOST_TRIES} times")
        return True

    def pause_s(state: object) -> float:
        chance = secrets.randbelow(1000) / 1000  # no two processes share it
        return min(PAUSE_S * 2 ** (number - 1), MAX_PAUSE_S) * (0.5 + chance)

    return Retrying(retry=is_worth_a_try, wait=pause_s)(function)


def root_error(error: BaseException) -> BaseException:
    """Return the cause: the HTTP driver reports every error of a request as a missing file."""
    wrappers = (FileNotFoundError, TransferFailed)
    while isinstance(error, wrappers) and error.__cause__ is not None:
        error = error.__cause__
    return error


def is_missing(error: BaseException) -> bool:
    """Return whether a server answered that there is no such file."""
    cause = root_error(error)
    return isinstance(cause, FileNotFoundError) or _status(cause) in (404, 410)


def is_absent(error: BaseException) -> bool:
    """Return whether a server answered that there is no such file, or none that we may see."""
    cause = root_error(error)
    return is_missing(error) or isinstance(cause, PermissionError) or _status(cause) in (401, 403)


def is_taken(error: BaseException) -> bool:
    """Return whether a server answered that there is such a file already."""
    return isinstance(error, FileExistsError) or 412 in (_status(error), _status(error.__cause__))


def may_pass(error: BaseException) -> bool:
    """Return whether the same request may succeed a little later."""
    status = _status(error)
    if status is not None:
        return status >= 500 or status in _MAY_PASS_STATUS
    return not isinstance(error, FileNotFoundError | PermissionError)


def describe(error: BaseException) -> str:
    """Return what went wrong in a few words without secrets."""
    status = _status(error)
    if status is not None:
        return f"the server answered with HTTP status {status}"
    if isinstance(error, FileNotFoundError):
        return "there is no such file"
    if isinstance(error, TimeoutError):
        return "no answer in time"
    text = printable(safe_text(str(error).partition("\n")[0]))
    return f"{type(error).__name__}: {text}"[:_MAX_MESSAGE].removesuffix(": ")


def _status(error: BaseException | None) -> int | None:
    """Return the HTTP status of an error, where the driver gives one (not all name it alike)."""
    response = getattr(error, "response", None)
    if isinstance(response, dict):  # botocore's
        status = response.get("ResponseMetadata", {}).get("HTTPStatusCode")
        return status if isinstance(status, int) else None
    for holder in (error, response):
        for name in ("status", "status_code", "code"):
            status = getattr(holder, name, None)
            if isinstance(status, int) and 300 <= status < 600:
                return status
    return None


class Pace:
    """Watches one file on its way, over all tries."""

    def __init__(
        self, position: Callable[[], int], clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Begin to watch.

        Args:
            position: how many bytes have come; falls where a transfer starts over.
            clock: seconds.
        """
        self._position = position
        self._clock = clock
        self._begun = self._window = self._tried = (clock(), position())

    def require(self) -> None:
        """Raise TransferFailed where the file comes too slowly, or took too long altogether.

        To be called at every arrival and after every try: what is slow ends within two windows.
        """
        now_s = self._clock()
        reached = self._position()
        if now_s - self._begun[0] > FILE_S:
            message = f"it did not come within {FILE_S:.0f} s"
            raise TransferFailed("download_failed", message)
        passed_s = now_s - self._window[0]
        moved = reached - self._window[1]
        if passed_s < WINDOW_S:
            return
        if moved < LEAST_BYTES_PER_S * passed_s:
            raise TransferFailed(
                "download_failed",
                f"it is too slow, {max(moved, 0)} bytes in {passed_s:.0f} s; expected at least "
                f"{LEAST_BYTES_PER_S:.0f} a second",
            )
        self._window = (now_s, reached)

    def has_moved_on(self) -> bool:
        """Return whether the file came at the least rate since this was asked last."""
        before_s, before = self._tried
        self._tried = now_s, reached = self._clock(), self._position()
        least = LEAST_BYTES_PER_S * (now_s - before_s)
        return reached - before > max(least, 0)


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
    off again and again without moving on, or comes too slowly (`Pace`);
    TrilightError where the driver's package is missing, or the disk is full.
    """
    driver = shared_driver(url)
    fill = _fill_http if url.is_http else _fill_bucket
    pace = Pace(stream.tell)
    expected = _Expected(num_bytes, max_bytes if num_bytes is None else num_bytes, pace)
    with_tries(lambda: fill(driver, url, stream, expected), pace=pace)


@dataclass
class _Expected:
    """Limits of a download: size, version and pace."""

    exact: int | None
    most: int
    pace: Pace
    version: dict[str, str] | None = None

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
            raise EOFError(f"got {len(piece)} of {end - start} bytes")
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
        raise EOFError(f"got {stream.tell()} of {expected.exact} bytes")


def _start_over(stream: BinaryIO, why: str = "") -> None:
    """Drop what has come, and for a reason interrupt the transfer."""
    stream.seek(0)
    stream.truncate()
    if why:
        raise EOFError(why)


_CHANGED = "the file changed while it was read"


def unreadable(url: RemoteUrl, error: TransferFailed) -> Unreadable:
    """Return the user's view of a file that cannot be read."""
    hint = " Public buckets need FSSPEC_S3_ANON=true." if url.scheme == "s3" else ""
    return Unreadable(
        f"{url.what} {url.display_url!r}: cannot be read ({error.message}); expected a file that "
        f"can be reached. Check the URL and your access to it.{hint}"
    )
