"""The scene files below a folder: their names alone, read once, so that a page only chooses."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pipeline.exchange.formats import readable
from storage.errors import TrilightError

MOST_FILES = 5000
"""Files that are listed; of a larger folder the first ones."""


@dataclass(frozen=True, kw_only=True)
class SceneList:
    """Files that may be scenes, in order."""

    root: Path
    names: tuple[str, ...]
    """Relative to the folder, with slashes."""
    is_cut: bool
    """Whether there are more files than these."""


def scene_list(root: Path) -> SceneList:
    """Return the files of a folder and of those in it whose suffix is that of a scene.

    Hidden folders and links to folders are left out.

    Raises:
        TrilightError: there is none.
    """
    suffixes = frozenset(readable())
    names = list[str]()
    for name in _files(root):
        if Path(name).suffix.lower() in suffixes:
            names.append(name)
        if len(names) > MOST_FILES:
            break
    if not names:
        raise TrilightError(
            f"{root}: no dataset, and holds no scene; expected a folder that `trilight generate` "
            f"wrote, or files {' '.join(readable())} in it."
        )
    return SceneList(root=root, names=tuple(names[:MOST_FILES]), is_cut=len(names) > MOST_FILES)


def _files(root: Path) -> Iterator[str]:
    for folder, below, files in os.walk(root):
        below[:] = sorted(name for name in below if not name.startswith("."))
        for name in sorted(files):
            if not name.startswith("."):
                yield Path(folder, name).relative_to(root).as_posix()
