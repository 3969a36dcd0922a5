"""Errors: a user's mistake, a failure of the environment, an unusable item, a removed setting."""

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from difflib import get_close_matches
from typing import Any, ClassVar


class TrilightError(ValueError):
    """A user's mistake.

    The message is one line that names the thing, the value got, the value expected and the next
    step. The command line prints it without a traceback and exits with its status.
    """

    exit_status: ClassVar[int] = 1
    """Exit status of a process that ends with this error."""


@contextlib.contextmanager
def prefix_errors(prefix: str) -> Iterator[None]:
    """Let the message of a TrilightError in the block begin with what it is about."""
    try:
        yield
    except TrilightError as error:
        raise TrilightError(f"{prefix}: {error}") from error


class EnvironmentFailure(TrilightError):
    """A failure of the environment that may pass: a full disk, too little memory, no server.

    The same call may succeed later, so a scheduler tries it again; any other TrilightError stays.
    """


class Unreadable(TrilightError):
    """A file cannot be read now, and may be whole: no permission, or no answer of a server."""


class Unrenderable(TrilightError):
    """A scene, or a view of it, of which a renderer can make no picture; a judge leaves it out."""


class ShardMissing(TrilightError):
    """A shard is not there."""


class Rejected(Exception):
    """An object, scene or view that breaks a law. It is data, not a failure of the program.

    A rejection is deterministic: the same input is always rejected for the same reason, so the run
    records it in `failures.jsonl` and goes on with the next attempt. The reason is a stable code in
    snake_case, such as `no_faces`; the message is one sentence for a person, with the value.
    """

    def __init__(self, reason: str, message: str) -> None:
        # both in args, so that it survives the way out of a child
        super().__init__(reason, message)
        self.reason = reason
        self.message = message

    def __str__(self) -> str:
        return f"{self.reason}: {self.message}"


OF_EXTENSION = "an extension's by --extend FILE"
"""Ends the list of names to which extensions may add."""


def expected_one_of(name: str, known: Iterable[str]) -> str:
    """Return the end of a message about an unknown name, with what was probably meant.

    Such as `did you mean smoke? Expected one of smoke, pretrain-256`, without a full stop.
    """
    names = list(known)
    listed = f"xpected one of {', '.join(names)}"
    swapped = (near for near in names if sorted(near) == sorted(name))  # such as tyni
    close = get_close_matches(name, names, n=1) or list(swapped)
    return f"did you mean {close[0]}? E{listed}" if close else f"e{listed}"


LAST_COMMIT = "643b412e"
"""The last commit that reads what was removed in November 2026."""


def removal_message(thing: str) -> str:
    """Return the refusal of `thing`, such as "weights.safetensors: sky tokens"."""
    return f"{thing}: removed since, and commit {LAST_COMMIT} is the last that reads it."


def without_removed(
    record: Mapping[str, Any], removed: Mapping[str, Any], source: str
) -> dict[str, Any]:
    """Return a stored record without the removed settings.

    Args:
        record: settings by name.
        removed: the removed settings, at the values that meant none.
        source: what stands before a setting's name in the refusal.

    Raises:
        TrilightError: a removed setting has another value.
    """
    for name, off in removed.items():
        if record.get(name, off) != off:
            raise TrilightError(removal_message(f"{source}.{name} is {record[name]!r}"))
    return {name: value for name, value in record.items() if name not in removed}
