"""Option `--extend FILE.py`, anywhere on the line: loads the user's files before the command."""

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


def load_extensions(words: Sequence[str]) -> list[str]:
    """Load the files of `--extend` and TRILIGHT_EXTEND; return the words without the option.

    The option is read before the commands, because the files may add names that they accept.

    Raises:
        TrilightError: a file cannot be loaded, or the option is the last word.
    """
    load_named_extensions()
    kept_words: list[str] = []
    waiting = iter(words)
    for word in waiting:
        if word == "--":
            return [*kept_words, word, *waiting]
        option, equals, file = word.partition("=")
        if option != OPTION:
            kept_words.append(word)
            continue
        if not equals:
            file = next(waiting, "")
        if not file:
            raise TrilightError(
                f"{OPTION}: names no file; expected {OPTION} FILE.py, a Python file of your own."
            )
        load_extension(file)
    for path, sha256 in loaded_files():
        with contextlib.suppress(TrilightError, OSError):  # only needed to print a next command
            write_atomically(_last_path_file(sha256), path.encode())
    return kept_words


def _last_path_file(sha256: str) -> Path:
    """Return the cache file with the path from which an extension was loaded last."""
    return cache_folder("extensions") / sha256


def extend_words(recorded: Mapping[str, str] = MappingProxyType({})) -> list[str]:
    """Return the `--extend` words that the next command needs.

    Args:
        recorded: sha256 of each extension of a dataset by name; an extension that this user has
            never loaded is left out.
    """
    paths = dict.fromkeys(path for path, _ in loaded_files())
    for sha256 in filter(str.isalnum, recorded.values()):
        with contextlib.suppress(TrilightError, OSError, ValueError):
            path = _last_path_file(sha256).read_text()
            if sha256_hex(Path(path).read_bytes()) == sha256:
                paths[path] = None
    return [word for path in paths for word in (OPTION, path)]


def resolve_reference(option: str, value: Any) -> Any:
    """Return the name of a typed preset; FILE.py:FUNCTION is loaded and registered first.

    Only words of the command line are resolved: forms and datasets never name a file.
    """
    if not isinstance(value, str) or not is_reference(value):
        return value
    if option == "build":
        from pipeline.presets.registry import resolve_dataset_preset

        return resolve_dataset_preset(value)
    if option == "run":
        from train.presets import resolve_training_preset

        return resolve_training_preset(value)
    return value
