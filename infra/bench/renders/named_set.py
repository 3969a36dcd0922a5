"""The scenes that renders are judged on: always the same ones, so that figures can be compared."""

import json
from pathlib import Path

from infra.bench.cycles.comparison import NamedScene, described, sampled
from storage.errors import TrilightError

NUM_SAMPLED = 20
"""Scenes of the build `smoke`, of built-in objects."""


def named_set(scenes: Path | None) -> list[NamedScene]:
    """Return the sampled scenes, after those of a folder of RenderFormer files if there is one.

    Args:
        scenes: the folder; each of its JSON files that holds a scene's objects is one.

    Raises:
        TrilightError: the folder holds none.
    """
    return _of_folder(scenes) + [sampled(index) for index in range(NUM_SAMPLED)]


def _of_folder(folder: Path | None) -> list[NamedScene]:
    if folder is None:
        return []
    root = folder.resolve()
    names = [path.name for path in sorted(root.glob("*.json")) if _holds_a_scene(path)]
    if not names:
        raise TrilightError(f"--scenes {folder}: holds no RenderFormer scene (*.json).")
    return [described(root, name) for name in names]


def _holds_a_scene(path: Path) -> bool:
    """Return whether a file has objects and a camera, as templates have not."""
    try:
        found = json.loads(path.read_bytes())
    except ValueError:
        return False
    return isinstance(found, dict) and bool(found.get("objects")) and bool(found.get("cameras"))
