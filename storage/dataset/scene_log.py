"""`logs/<shard>.jsonl`: what must not be in a dataset, one row per scene: times, hosts, retries."""

import json
import os
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass

from storage.atomic import write_error
from storage.dataset.layout import DatasetFolder
from storage.records.sample import sample_key


@dataclass(frozen=True, kw_only=True)
class SceneLog:
    """One scene that somebody made."""

    seconds: float
    """Wall time."""
    cores: int
    """Cores that its maker had for it."""
    finished_unix_s: float
    """When, by the maker's clock."""


def log_scene(
    folder: DatasetFolder,
    shard: str,
    scene_index: int,
    *,
    seconds: float,
    cores: int,
    num_rejected: int,
) -> None:
    """Append the row of a scene that is made.

    Raises:
        TrilightError: the disk is full or the folder cannot be written.
    """
    row = {
        "scene": sample_key(scene_index),
        "seconds": round(seconds, 3),
        "cores": cores,
        "rejected_attempts": num_rejected,
        "host": socket.gethostname(),
        "pid": os.getpid(),
        "finished_unix_s": round(time.time(), 1),
    }
    path = folder.root / log_name(shard)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as stream:
            stream.write(json.dumps(row) + "\n")
    except OSError as error:
        raise write_error(path, error) from error


def read_scene_logs(folder: DatasetFolder) -> Iterator[SceneLog]:
    """Yield what the logs of a dataset say; rows that a kill has cut are left out."""
    for path in sorted(folder.logs.rglob("*.jsonl")):
        yield from decode_scene_log(path.read_text())


def log_name(shard: str) -> str:
    """Return the name of a shard's log, relative to the dataset."""
    return f"logs/{shard}.jsonl"


def decode_scene_log(text: str) -> Iterator[SceneLog]:
    """Yield what the rows of a log say; those that a kill has cut are left out."""
    for line in text.splitlines():
        try:
            row = json.loads(line)
            yield SceneLog(
                seconds=float(row["seconds"]),
                cores=int(row.get("cores", 1)),  # earlier versions did not say
                finished_unix_s=float(row["finished_unix_s"]),
            )
        except (ValueError, KeyError, TypeError, AttributeError):
            continue
