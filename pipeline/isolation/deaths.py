"""What can end a call in a child, how often the call is tried again, and which ends are verdicts.

A kill changes nothing that is made. So an end that the environment may have brought about is never
remembered of an item and never leads to another method, another level or another picture: the same
call is made again in a fresh child, and where that does not help, the item fails for this run only.
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
"""After the first failure of the environment, twice as long after the second: what passes by
itself, such as a lack of memory, has time to pass."""


@dataclass(frozen=True, kw_only=True)
class End:
    """One way in which a call can end without an answer."""

    tries: int
    """Calls that must end so, each in a fresh child, before no other one is made."""
    is_verdict: bool
    """Whether the call itself is to blame then: it would end so in every run, and an outcome that
    follows from it may be kept. Otherwise the environment is to blame, and nothing may be kept."""


ENDS: Mapping[str, End] = {
    # The kernel counts what the call uses, whatever else the machine does, and it would use that
    # again.
    "timeout_cpu": End(tries=1, is_verdict=True),
    # Native code that fails on an item fails on it again. Once may be the fault of a child that
    # has leaked, or of an unchecked failed allocation.
    "crashed_signal": End(tries=2, is_verdict=True),
    # The signal came from outside: the system for want of memory, an operator, a scheduler.
    "killed": End(tries=3, is_verdict=False),
    "stopped": End(tries=3, is_verdict=False),
    # How much address space an item needs depends on threads and libraries, thus on the machine,
    # and an allocation also fails for want of memory in all.
    "out_of_memory": End(tries=3, is_verdict=False),
    # The machine was busy, or a file did not come. Two, since each costs the whole time.
    "timeout_wall": End(tries=2, is_verdict=False),
    # An unforeseen exit or Python error: our mistake, or a missing file
    # or thread. Neither breaks a law of the item.
    "crashed": End(tries=3, is_verdict=False),
    "exception": End(tries=3, is_verdict=False),
    # The child says what it was not asked for: it has lost its mind, or a file has taken it over.
    "nonsense": End(tries=2, is_verdict=False),
}
"""Ends by reason; the keys carry no signal number."""


class ChildFailed(Exception):
    """The child died, hung, or raised something unexpected: the environment's fault, or a bug.

    Attributes:
        reason: a name of `ENDS`; `crashed_signal` is followed by the signal's number.
        message: one sentence with what is known.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(f"{reason}: {message}")
        self.reason = reason
        self.message = message

    @property
    def sentence(self) -> str:
        """What records hold of it: of an error that nobody foresaw its type, not its words."""
        if self.reason != "exception":
            return self.message
        kind = re.search(r"\b(\w{0,60}(?:Error|Exception))(?::| \||$)", self.message)
        return f"an unforeseen error ({kind[1] if kind else 'unknown'}); the log has it"

    @property
    def is_verdict(self) -> bool:
        """Whether the call itself is to blame, once `with_retries` has given up."""
        return ENDS[_kind(self.reason)].is_verdict


def is_passing(reason: str) -> bool:
    """Return whether an item that failed for this reason may succeed in the next run."""
    end = ENDS.get(_kind(reason))
    return end is not None and not end.is_verdict


def with_retries(call: Callable[[], Result]) -> Result:
    """Return what `call` returns; where a child fails, call again as often as `ENDS` says.

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
