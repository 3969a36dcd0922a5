"""`--extend FILE.py`, anywhere on the line: files of the user's own, loaded before any command."""

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from storage.atomic import write_atomically
from storage.cache import cache_folder
from storage.digests import sha256_hex
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
    for path, sha256 in loaded_files():
        with contextlib.suppress(TrilightError, OSError):  # it only helps to print a command
            write_atomically(_place_of(sha256), path.encode())
    return left


def _place_of(sha256: str) -> Path:
    """Return the file of the user's cache that says where an extension was loaded last."""
    return cache_folder("extensions") / sha256


def extend_words(recorded: Mapping[str, str] = MappingProxyType({})) -> list[str]:
    """Return the words that load what a command needs that goes on from this one.

    Args:
        recorded: sha256 of each extension that a dataset was made with, by its name: of those that
            this user has never loaded, no file is named.
    """
    paths = dict.fromkeys(path for path, _ in loaded_files())
    for sha256 in filter(str.isalnum, recorded.values()):
        with contextlib.suppress(TrilightError, OSError, ValueError):
            path = _place_of(sha256).read_text()
            if sha256_hex(Path(path).read_bytes()) == sha256:
                paths[path] = None
    return [word for path in paths for word in (OPTION, path)]


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
