"""The ways in which something can be wrong: a user's mistake, the machine, an unusable item."""


class TrilightError(ValueError):
    """A user's mistake.

    The message is one line that names the thing, the value got, the value expected and the next
    step. The command line prints it without a traceback and exits with a non-zero status.
    """


class EnvironmentFailure(TrilightError):
    """Something outside of us that may pass: a full disk, a lack of memory, a server away.

    The same call may succeed later, so a scheduler tries it again; any other TrilightError stays.
    """


class Rejected(Exception):
    """An object, scene or view that breaks a law. It is data, not a failure of the program.

    A rejection is deterministic: the same input is always rejected for the same reason, so the
    run records it in `failures.jsonl` and goes on with the next attempt.

    Attributes:
        reason: a stable code in snake_case, such as `no_faces` or `black_view`.
        message: one sentence for a person, with the value that was found.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(
            reason, message
        )  # both in args, so that it survives the way out of a child
        self.reason = reason
        self.message = message

    def __str__(self) -> str:
        return f"{self.reason}: {self.message}"
