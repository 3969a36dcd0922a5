"""Fetching many things that may each fail: tries, clean messages, a few at a time."""

import errno
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import TypeVar

from pipeline.objects.listing import Fetched, Progress, failure
from pipeline.objects.names import printable
from storage.errors import TrilightError
from storage.records import Failure, ObjectRecord
from storage.safe_url import safe_text

Result = TypeVar("Result")

TRIES = 3
PAUSE_S = 0.5
"""Before the second try; doubled before each further one."""
_MAX_MESSAGE = 200
_MAY_PASS_STATUS = (408, 425, 429)


class TransferFailed(Exception):
    """Something cannot be had, for good.

    Attributes:
        reason: a stable code in snake_case.
        message: a sentence without secrets.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(reason, message)
        self.reason = reason
        self.message = message


class Interrupted(Exception):
    """A transfer ended early, for the reason that is its `__cause__`."""


def with_tries(function: Callable[[], Result]) -> Result:
    """Call up to TRIES times while what goes wrong may pass by itself.

    Raises:
        TransferFailed: as the function raised it, or `download_failed` for any other exception.
        TrilightError: as the function raised it, or the disk is full.
    """
    for number in range(TRIES):
        try:
            return function()
        except (TransferFailed, TrilightError):
            raise
        except Exception as error:  # drivers raise what they like
            cause = root_error(error)
            if isinstance(cause, OSError) and cause.errno in (errno.ENOSPC, errno.EDQUOT):
                raise TrilightError(
                    "objects: the disk is full. What was downloaded is safe: free some space and "
                    "run the same command again."
                ) from error
            if number + 1 == TRIES or not _may_pass(cause):
                raise TransferFailed("download_failed", describe(cause)) from error
            time.sleep(PAUSE_S * 2**number)
    raise AssertionError("unreachable: TRIES is at least 1")


def root_error(error: BaseException) -> BaseException:
    """Return what went wrong: the HTTP driver reports every error of a question as a lack."""
    while isinstance(error, FileNotFoundError | Interrupted) and error.__cause__ is not None:
        error = error.__cause__
    return error


def is_absent(error: BaseException) -> bool:
    """Say whether a server answered that there is no such file, or none that we may see."""
    cause = root_error(error)
    return isinstance(cause, FileNotFoundError | PermissionError) or _status(cause) in (
        401, 403, 404, 410,
    )  # fmt: skip


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


def fetch_all(
    records: list[ObjectRecord],
    fetch: Callable[[ObjectRecord], ObjectRecord],
    downloaded: Progress,
    *,
    threads: int,
    stop: threading.Event,
) -> Fetched:
    """Fetch every object; a TransferFailed of `fetch` is a failure of that object alone.

    Args:
        records: what to fetch.
        fetch: returns the record with its path; called in threads, at most `threads` at a time.
        downloaded: called in this thread with how many are done, failed ones included, and with
            how many there are.
        threads: at least 1.
        stop: set where the run ends early, so that `fetch` may give up.

    Raises:
        Exception: whatever else `fetch` raises; what has not begun by then is left out.
    """
    here: list[ObjectRecord] = []
    failures: list[Failure] = []
    downloaded(0, len(records))
    with ThreadPoolExecutor(threads) as pool:
        waiting = {pool.submit(fetch, record): record for record in records}
        try:
            for done, future in enumerate(as_completed(waiting), start=1):
                try:
                    here.append(future.result())
                except TransferFailed as error:
                    failures.append(failure(waiting[future].uid, error.reason, error.message))
                downloaded(done, len(records))
        except BaseException:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return here, failures


def _status(error: BaseException) -> int | None:
    """Return the HTTP status of an error, where the driver gives one (not all name it alike)."""
    for holder in (error, getattr(error, "response", None)):
        for name in ("status", "status_code", "code"):
            status = getattr(holder, name, None)
            if isinstance(status, int) and 300 <= status < 600:
                return status
    return None


def _may_pass(error: BaseException) -> bool:
    status = _status(error)
    if status is not None:
        return status >= 500 or status in _MAY_PASS_STATUS
    return not isinstance(error, FileNotFoundError | PermissionError)
