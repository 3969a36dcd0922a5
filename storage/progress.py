"""How far a dataset is, from its files alone: anybody may look, from any process."""

import json
from dataclasses import dataclass
from pathlib import Path

from storage.atomic import write_atomically
from storage.errors import TrilightError
from storage.layout import DatasetFolder
from storage.manifest import read_manifest


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Counts of what is finished and of what is planned; 0 planned where it is not known yet."""

    downloads_done: int
    """Object files that have come from a server, or failed to."""
    downloads_planned: int
    """Object files to fetch; 0 for sources on this machine."""
    objects_done: int
    """Objects that are prepared or rejected."""
    objects_planned: int
    """Objects to prepare."""
    scenes_done: int
    """Scenes in shards or waiting for their shard."""
    scenes_planned: int
    """Scenes to make."""


def announce_downloads(folder: DatasetFolder, done: int, total: int) -> None:
    """Write down how many object files have come from a server."""
    write_atomically(_downloads(folder), json.dumps([done, total]).encode())


def announce_objects(folder: DatasetFolder, num_objects: int) -> None:
    """Write down how many objects the asset stage will look at, and that none is done."""
    write_atomically(_done(folder), b"")
    write_atomically(_plan(folder), json.dumps({"objects": num_objects}).encode())


def count_object(folder: DatasetFolder) -> None:
    """Write down that one more object is prepared or rejected: a byte, from any thread."""
    with _done(folder).open("ab") as stream:
        stream.write(b".")


def read_progress(folder: DatasetFolder) -> Progress:
    """Count files; cheap enough to be called twice a second."""
    try:
        manifest = read_manifest(folder.manifest)
        scenes_planned, in_shards = manifest.num_scenes, manifest.num_samples
    except TrilightError:
        scenes_planned = in_shards = 0
    plan = json.loads(_plan(folder).read_bytes()) if _plan(folder).exists() else {"objects": 0}
    staged = sum(path.is_file() for path in (folder.staging / "samples").rglob("*.tar"))
    done, total = (
        json.loads(_downloads(folder).read_bytes()) if _downloads(folder).exists() else (0, 0)
    )
    return Progress(
        downloads_done=done,
        downloads_planned=total,
        objects_done=_done(folder).stat().st_size if _done(folder).exists() else 0,
        objects_planned=plan["objects"],
        scenes_done=in_shards + staged,
        scenes_planned=scenes_planned,
    )


def _plan(folder: DatasetFolder) -> Path:
    return folder.staging / "plan.json"


def _downloads(folder: DatasetFolder) -> Path:
    return folder.staging / "downloads.json"


def _done(folder: DatasetFolder) -> Path:
    return folder.staging / "objects_done"
