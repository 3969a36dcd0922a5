"""Names that people type: what a shell offers for them, and how one of their own is read.

Only words of the command line come here: FILE.py:FUNCTION runs a file, and must come from nowhere
else.
"""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Names:
    """The names that a field takes."""

    known: Callable[[], list[str]]
    """Returns those that there are."""
    read: Callable[[str], str] = str
    """Returns the name of what was typed."""


def _builds() -> list[str]:
    from pipeline.flows.builds import BUILDS

    return list(BUILDS)


def _typed_build(typed: str) -> str:
    from pipeline.flows.builds import typed_build

    return typed_build(typed)


def _runs() -> list[str]:
    from train.runs import RUNS

    return list(RUNS)


def _typed_run(typed: str) -> str:
    from train.runs import typed_run

    return typed_run(typed)


def _runners() -> list[str]:
    from pipeline.flows.executors import EXECUTORS

    return list(EXECUTORS)


def _sizes() -> list[str]:
    from model.config import SIZES

    return list(SIZES)


NAMES: dict[str, Names] = {
    "build": Names(_builds, _typed_build),
    "run": Names(_runs, _typed_run),
    "runner": Names(_runners),
    "network": Names(_sizes),
}
"""By the field that takes one."""
