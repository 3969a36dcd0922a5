"""Names of the scene files below a folder, read once, so that a page only selects from a list."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pipeline.exchange.formats import readable_suffixes
from storage.errors import TrilightError

MOST_FILES = 5000
"""Maximum number of listed files; a larger folder is cut."""


@dataclass(frozen=True, kw_only=True)
class SceneList:
    """Sorted files that may be scenes."""

    root: Path
    names: tuple[str, ...]
    """Paths relative to the folder, with slashes."""
    is_cut: bool
    """True where the folder has more files than are listed."""


def scene_list(root: Path) -> SceneList:
    """Return the files with a scene's suffix in a folder and its subfolders.

    Hidden folders and links to folders are left out.

    Raises:
        TrilightError: there is no such file.
    """
    suffixes = frozenset(readable_suffixes())
    names = list[str]()
    for name in _files(root):
        if Path(name).suffix.lower() in suffixes:
            names.append(name)
        if len(names) > MOST_FILES:
            break
    if not names:
        raise TrilightError(
            f"{root}: no dataset, and holds no scene; expected a folder that `trilight generate` "
            f"wrote, or files {' '.join(readable_suffixes())} in it."
        )
    return SceneList(root=root, names=tuple(names[:MOST_FILES]), is_cut=len(names) > MOST_FILES)


def _files(root: Path) -> Iterator[str]:
    for folder, below, files in os.walk(root):
        below[:] = sorted(name for name in below if not name.startswith("."))
        for name in sorted(files):
            if not name.startswith("."):
                yield Path(folder, name).relative_to(root).as_posix()
