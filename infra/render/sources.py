"""Scenes of a source that may hold many: a file, a folder, or numbered files."""

import re
from pathlib import Path

from pipeline.exchange.formats import SceneSource, readable_suffixes
from pipeline.exchange.open_scene import scene_source
from pipeline.exchange.reader import SceneReader
from storage.dataset.shard_places import expand_pattern
from storage.errors import TrilightError


def scene_sources(text: str, reader: SceneReader) -> list[SceneSource]:
    """Return every scene of a source, in order.

    Args:
        text: one file; `scenes/{000..119}.json` for numbered ones; or a folder, whose scene files
            are sorted by the numbers in their names. A shard stands for all of its samples, an
            animated USD stage for all of its frames.
        reader: reader for files that may hold many scenes.

    Raises:
        TrilightError: a file is unusable, or there is no scene.
    """
    if "://" not in text and Path(text).is_dir():
        return [scene_source(str(path)) for path in _scene_files(Path(text))]
    names = expand_pattern(text, "scenes") if "{" in text else [text]
    files = [scene_source(name, many=True) for name in names]
    return [scene for source in files for scene in reader.scenes_of(source)]


def _scene_files(folder: Path) -> list[Path]:
    paths = [path for path in folder.iterdir() if path.suffix.lower() in readable_suffixes()]
    if not paths:
        raise TrilightError(
            f"{folder}: holds no scene file; expected files that end in "
            f"{' '.join(readable_suffixes())}."
        )
    return sorted(paths, key=lambda path: _by_number(path.name))


def _by_number(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts frame9 before frame10."""
    parts = re.split(r"([0-9]+)", name)
    return [(int(part), part) if part.isdecimal() else (-1, part) for part in parts]
