"""Retries of remote requests, the least rate of a transfer, and error messages without secrets."""

import errno
import secrets
import time
from collections.abc import Callable
from typing import Any, TypeVar

from storage.errors import EnvironmentFailure, TrilightError
from storage.remote.url import printable, safe_text

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


class Interrupted(Exception):
    """A transfer ended early, for the reason that is its `__cause__`."""


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
    wrappers = (FileNotFoundError, Interrupted, TransferFailed)
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
