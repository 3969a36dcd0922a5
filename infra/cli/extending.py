"""`--extend FILE.py`, anywhere on the line: files of the user's own, loaded before any command."""

from collections.abc import Sequence
from typing import Any

from storage.errors import TrilightError
from storage.extensions import (
    is_reference,
    load_extension,
    load_named_extensions,
    loaded_files,
)

OPTION = "--extend"


def extended(words: Sequence[str]) -> list[str]:
    """Load what `--extend` and TRILIGHT_EXTEND name, and return the words without the option.

    It is taken out here, since a command's own options are only known once its tables are filled.

    Raises:
        TrilightError: as `load_extension`, or the option is the last word.
    """
    load_named_extensions()
    left: list[str] = []
    waiting = iter(words)
    for word in waiting:
        if word == "--":
            return [*left, word, *waiting]
        option, equals, file = word.partition("=")
        if option != OPTION:
            left.append(word)
            continue
        if not equals:
            file = next(waiting, "")
        if not file:
            raise TrilightError(
                f"{OPTION}: names no file; expected {OPTION} FILE.py, a Python file of your own."
            )
        load_extension(file)
    return left


def extend_words() -> list[str]:
    """Return the words that load what is loaded here, for a command that goes on from this one."""
    return [word for path, _ in loaded_files() for word in (OPTION, path)]


def registered(option: str, value: Any) -> Any:
    """Return the name of a build or run that was typed; FILE.py:FUNCTION is loaded and named.

    Only the command line comes here: what a form or a dataset says never names a file.
    """
    if not isinstance(value, str) or not is_reference(value):
        return value
    if option == "build":
        from pipeline.builds.named import typed_build

        return typed_build(value)
    if option == "run":
        from train.runs import typed_run

        return typed_run(value)
    return value
