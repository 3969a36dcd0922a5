"""A folder for each case of a test that goes through many."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any


def with_folders(root: Path, cases: Iterable[Any]) -> Iterator[tuple[Path, Any]]:
    """Yield each case with an empty folder of its own below `root`."""
    for number, case in enumerate(cases):
        folder = root / str(number)
        folder.mkdir()
        yield folder, case
