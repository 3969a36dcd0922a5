"""Lists and parses the scene files of a folder.

Scene k is the k-th `*.json` of the folder by name. An unusable file keeps its number: that scene is
rejected, and a row of failures.jsonl states the reason.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.exchange.description import SceneDescription
from pipeline.exchange.from_description import AlbedoOverOne
from pipeline.exchange.scene_files import read_scene_description
from storage.errors import EnvironmentFailure, TrilightError

MAX_SCENES = 100_000
"""Maximum number of scene files in a folder."""


@dataclass(frozen=True, kw_only=True)
class SceneFolder:
    """The scene files of one folder."""

    root: Path  # the folder, with links resolved; nothing outside it is read
    names: tuple[str, ...]
    """Names of all scene files, sorted; the position is the scene index, usable or not."""
    descriptions: tuple[SceneDescription, ...]  # of the usable files, in the same order
    unusable: Mapping[str, str]  # reason for each other file, by its name
    albedo_over_one: AlbedoOverOne  # treatment of albedos over 1

    def views(self, num_views: int | None) -> int:
        """Return the number of views of each scene: `num_views`, or the fewest cameras of a file.

        Cameras come from the files alone; none is added.

        Raises:
            TrilightError: a file has fewer cameras than `num_views`.
        """
        fewest = min(self.descriptions, key=lambda description: len(description.cameras))
        if num_views is None:
            return len(fewest.cameras)
        if not 1 <= num_views <= len(fewest.cameras):
            raise TrilightError(
                f"--views is {num_views}; expected 1 to {len(fewest.cameras)}, the number of "
                f"cameras in {fewest.file}: choose fewer views, or add cameras to the file."
            )
        return num_views

    def notes(self, num_views: int) -> tuple[str, ...]:
        """Return a sentence for each unknown field and each file with unused cameras."""
        notes = []
        for description in self.descriptions:
            notes += [
                f"{description.file}: unknown field {name}" for name in description.unknown_fields
            ]
            if (unused := len(description.cameras) - num_views) > 0:
                notes.append(
                    f"{description.file}: {unused} of {len(description.cameras)} cameras not used, "
                    f"from cameras[{num_views}] on"
                )
        return tuple(notes)


def find_scene_files(folder: str, albedo_over_one: AlbedoOverOne = "scale") -> SceneFolder:
    """Read every `*.json` of a local folder, without its subfolders.

    Raises:
        TrilightError: the folder is missing, or has no scene files, too many, or no usable one.
    """
    root = Path(folder)
    if not root.is_dir():
        raise TrilightError(f"--scenes-from {folder}: no such folder; expected one of *.json.")
    root = root.resolve()
    names = sorted(path.name for path in root.glob("*.json"))
    if not 1 <= len(names) <= MAX_SCENES:
        raise TrilightError(
            f"--scenes-from {folder}: {len(names)} files *.json; expected 1 to {MAX_SCENES}."
        )
    for name in names:
        if not name.isprintable():
            raise TrilightError(
                f"--scenes-from {folder}: rename {name!r}; expected printable text."
            )
    descriptions = []
    unusable = {}
    for name in names:
        try:
            descriptions.append(read_scene_description(root, name))
        except EnvironmentFailure:
            raise
        except TrilightError as mistake:
            unusable[name] = str(mistake)
    require_usable(names, unusable)
    return SceneFolder(
        root=root,
        names=tuple(names),
        descriptions=tuple(descriptions),
        unusable=unusable,
        albedo_over_one=albedo_over_one,
    )


def require_usable(names: Sequence[str], unusable: Mapping[str, str]) -> None:
    """Raise TrilightError where no file is usable; the message gives the first reason."""
    if len(unusable) == len(names):
        raise TrilightError(
            f"--scenes-from: none of the {len(names)} scene files is usable; the first: "
            f"{unusable[names[0]]}"
        )
