"""How far a dataset is, from its files alone: anybody may look, from any process."""

import contextlib
import functools
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from storage.atomic import write_atomically, write_error
from storage.dataset.derived import derivation_of
from storage.dataset.layout import DatasetFolder, numbered
from storage.dataset.manifest import Manifest, read_manifest
from storage.dataset.splits import scenes_of_shard, shard_name, shards_for
from storage.errors import TrilightError
from storage.settings.dataset import SplitSettings

_AT_WORK_S = 600.0
"""What is told of a scene is not older than a pass of samples takes; else a kill has left it."""


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
    num_views: int
    """Views of a scene."""
    views_done: float
    """Views of the finished scenes, and how far those of the scenes at work are."""


def announce_downloads(folder: DatasetFolder, done: int, total: int) -> None:
    """Write down how many object files have come from a server."""
    write_atomically(_downloads(folder), json.dumps([done, total]).encode())


def announce_objects(folder: DatasetFolder, num_objects: int) -> None:
    """Write down how many objects the asset stage will look at, and that none is done."""
    write_atomically(_done(folder), b"")
    write_atomically(_plan(folder), json.dumps({"objects": num_objects}).encode())


def count_object(folder: DatasetFolder) -> None:
    """Write down that one more object is prepared or rejected: a byte, from any thread."""
    path = _done(folder)
    try:
        with path.open("ab") as stream:
            stream.write(b".")
    except OSError as error:
        raise write_error(path, error) from error


def tell_views(folder: DatasetFolder, scene_index: int, views: float) -> None:
    """Write down how many views of a scene at work are finished, the one at hand in part.

    It is for people alone, so that where it cannot be written nothing is said.
    """
    with contextlib.suppress(OSError):
        path = _at_work(folder) / numbered(scene_index, f"{scene_index:09d}")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{views:.3f}")


def forget_views(folder: DatasetFolder, scene_index: int) -> None:
    """Take back what `tell_views` wrote: the scene is finished, or begun anew."""
    with contextlib.suppress(OSError):
        (_at_work(folder) / numbered(scene_index, f"{scene_index:09d}")).unlink()


def read_progress(folder: DatasetFolder) -> Progress:
    """Count files; cheap enough to be called twice a second: a manifest is read when it changes."""
    try:
        facts = folder.manifest.stat()
        scenes_planned, num_views, planned = _plan_of(
            folder.manifest, facts.st_mtime_ns, facts.st_size
        )
        scenes_done = num_scenes_done(folder, planned)
    except (TrilightError, OSError):
        scenes_planned = num_views = scenes_done = 0
    plan = json.loads(_plan(folder).read_bytes()) if _plan(folder).exists() else {"objects": 0}
    done, total = (
        json.loads(_downloads(folder).read_bytes()) if _downloads(folder).exists() else (0, 0)
    )
    return Progress(
        downloads_done=done,
        downloads_planned=total,
        objects_done=_done(folder).stat().st_size if _done(folder).exists() else 0,
        objects_planned=plan["objects"],
        scenes_done=scenes_done,
        scenes_planned=scenes_planned,
        num_views=num_views,
        views_done=scenes_done * num_views + _views_at_work(folder),
    )


def _views_at_work(folder: DatasetFolder) -> float:
    """Return how many views are told of that a kill has not left long ago."""
    since = time.time() - _AT_WORK_S
    told = 0.0
    for path in _at_work(folder).rglob("[0-9]*"):
        with contextlib.suppress(OSError, ValueError):  # it is gone, or half written
            if path.is_file() and path.stat().st_mtime > since:
                told += float(path.read_text())
    return told


@functools.lru_cache(maxsize=4)
def _plan_of(manifest: Path, mtime_ns: int, num_bytes: int) -> tuple[int, int, Mapping[str, int]]:
    """Return scenes, views of each, and shards of a manifest, known by the time and size of it."""
    found = read_manifest(manifest)
    return found.num_scenes, found.num_views, planned_shards(found)


def planned_shards(manifest: Manifest) -> dict[str, int]:
    """Return the names of the shards of the finished dataset, with their numbers of scenes."""
    if derivation_of(manifest.settings):
        return {entry.name: entry.num_samples for entry in manifest.shards}
    splits = SplitSettings(**manifest.settings["splits"])
    return {
        shard_name(index, splits): len(scenes_of_shard(index, splits))
        for index in range(shards_for(manifest.num_scenes, splits))
    }


def shards_there(folder: DatasetFolder) -> set[str]:
    """Return the names of the shards that are there under their final names, listed or not."""
    here = {path.relative_to(folder.root).as_posix() for path in folder.shard_files()}
    if not folder.bucket:
        return here
    sent = folder.staged_sent
    return here | {path.relative_to(sent).as_posix() for path in sent.rglob("*.tar")}


def num_scenes_done(folder: DatasetFolder, planned: Mapping[str, int]) -> int:
    """Return how many scenes are in shards, listed or not, or wait for theirs.

    Args:
        folder: of the dataset.
        planned: what `planned_shards` says of it.
    """
    there = shards_there(folder) & planned.keys()
    unpacked = sum(path.is_file() for path in folder.staged_samples.rglob("*.tar"))
    return sum(planned[name] for name in there) + unpacked


def _at_work(folder: DatasetFolder) -> Path:
    return folder.staging / "at_work"


def _plan(folder: DatasetFolder) -> Path:
    return folder.staging / "plan.json"


def _downloads(folder: DatasetFolder) -> Path:
    return folder.staging / "downloads.json"


def _done(folder: DatasetFolder) -> Path:
    return folder.staging / "objects_done"
