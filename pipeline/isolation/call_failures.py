"""The ways a call in a child can fail, the number of retries, and which failures are verdicts.

A kill must not change any output. So a failure that the environment may have caused is never stored
for an item and never leads to another method, level or picture: the same call is repeated in a
fresh child, and if that does not help, the item fails for this run only.
"""

import logging
import re
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

Result = TypeVar("Result")

_LOG = logging.getLogger("trilight.children")

_PAUSE_S = 0.5
"""Seconds after the first failure of the environment, twice as long after the second: a transient
lack of memory has time to end."""


@dataclass(frozen=True, kw_only=True)
class End:
    """Retry policy of one way in which a call can fail."""

    tries: int
    """Number of such failures, each in a fresh child, after which the call is given up."""
    is_verdict: bool
    """True if the call itself is to blame: it would fail so in every run, and a result that follows
    from it may be stored. Otherwise the environment is to blame, and nothing may be stored."""


ENDS: Mapping[str, End] = {
    # The kernel counts the CPU time of the call, independent of other load: a retry would use the
    # same.
    "timeout_cpu": End(tries=1, is_verdict=True),
    # Native code that fails on an item fails on it again. One failure may come from a leak in the
    # child, or from an unchecked failed allocation.
    "crashed_signal": End(tries=2, is_verdict=True),
    # The signal came from outside: the system for want of memory, an operator, a scheduler.
    "killed": End(tries=3, is_verdict=False),
    "stopped": End(tries=3, is_verdict=False),
    # The address space that an item needs depends on threads and libraries, thus on the machine,
    # and an allocation also fails if the machine is out of memory.
    "out_of_memory": End(tries=3, is_verdict=False),
    # The machine was busy, or a file system was slow. Two, since each try costs the whole time.
    "timeout_wall": End(tries=2, is_verdict=False),
    # An unforeseen exit or Python error: a bug, or a missing file or thread. Neither says that the
    # item is invalid.
    "crashed": End(tries=3, is_verdict=False),
    "exception": End(tries=3, is_verdict=False),
    # Protocol violation: a corrupt or compromised child.
    "nonsense": End(tries=2, is_verdict=False),
}
"""Retry policy by reason; the keys have no signal number."""


class ChildFailed(Exception):
    """The child died, hung, or raised an unexpected error: the environment's fault, or a bug.

    Attributes:
        reason: a key of `ENDS`; the number of the signal follows `crashed_signal`.
        message: one sentence with the cause, as far as it is known.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(f"{reason}: {message}")
        self.reason = reason
        self.message = message

    @property
    def sentence(self) -> str:
        """Text for stored records: for an unforeseen error its type, not its message."""
        if self.reason != "exception":
            return self.message
        kind = re.search(r"\b(\w{0,60}(?:Error|Exception))(?::| \||$)", self.message)
        return f"an unforeseen error ({kind[1] if kind else 'unknown'}); the log has it"

    @property
    def is_verdict(self) -> bool:
        """True if the call itself is to blame, once `with_retries` has given up."""
        return ENDS[_kind(self.reason)].is_verdict


def is_transient(reason: str) -> bool:
    """Return True if an item that failed for this reason may succeed in the next run."""
    end = ENDS.get(_kind(reason))
    return end is not None and not end.is_verdict


def with_retries(call: Callable[[], Result]) -> Result:
    """Return the result of `call`; if the child fails, retry as often as `ENDS` allows.

    Raises:
        ChildFailed: the last failure.
    """
    failures: Counter[str] = Counter()
    while True:
        try:
            return call()
        except ChildFailed as failure:
            kind = _kind(failure.reason)
            failures[kind] += 1
            if failures[kind] >= ENDS[kind].tries:
                if failure.reason == "exception":
                    _LOG.warning("%s", failure)
                raise
            if not failure.is_verdict:
                time.sleep(_PAUSE_S * failures[kind])


def _kind(reason: str) -> str:
    return reason.rstrip("_0123456789")
