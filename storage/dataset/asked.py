"""`logs/asked.json`: the words of the command that makes a dataset, so that it can be repeated.

It is no part of the dataset's identity, names no folder of the dataset, and may be missing.
"""

import itertools
import json
from collections.abc import Sequence

from storage.atomic import write_atomically
from storage.dataset.dataset import Dataset
from storage.dataset.layout import DatasetFolder
from storage.errors import TrilightError
from storage.extensions import is_reference
from storage.typed_json import read_json

_NAME = "logs/asked.json"


def write_asked(folder: DatasetFolder, words: Sequence[str]) -> None:
    """Write down the words after `trilight`, without where the dataset is."""
    write_atomically(folder.root / _NAME, (json.dumps(list(words)) + "\n").encode())


def read_asked(dataset: Dataset) -> list[str] | None:
    """Return what was written down; None where nothing is, or nothing that may be shown.

    The file may come from the dataset's publisher: only words of `generate` that print come back,
    and none that would run a file when they are repeated.
    """
    try:
        words = read_json(dataset.files.read(_NAME) or b"[]", list[str], _NAME)
    except TrilightError:
        return None
    if words[:1] != ["generate"]:
        return None
    harmless = all(
        word.isprintable() and not (is_reference(word) or word.startswith("--extend"))
        for word in words
    )
    return words if harmless else None


def value_of(words: Sequence[str], option: str) -> str | None:
    """Return the word after an option; None where the option is missing."""
    return next((value for name, value in itertools.pairwise(words) if name == option), None)
