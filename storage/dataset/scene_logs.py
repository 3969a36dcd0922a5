"""Logs of a dataset: a row for each scene that is made, in `logs/<shard>.jsonl`.

They hold what must not be in a dataset: times, hosts, retries. Any process may read them. Of very
many, a look reads those that were written last, and evenly spaced ones that stand for all.
"""

import contextlib
import dataclasses
import heapq
import json
import os
import socket
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from storage.atomic import append_line
from storage.dataset.layout import DatasetFolder
from storage.errors import TrilightError
from storage.records.sample import sample_key
from storage.settings.ranges import Within
from storage.typed_json import read_json

LAST_SCENES = 200
"""Scenes over which a rate is taken."""
MOST_LOGS = 1024
"""Maximum number of logs that stand for all."""


Seconds = Annotated[float, Within(0, 1e12, unit="seconds")]


@dataclass(frozen=True, kw_only=True)
class SceneLog:
    """Log row of one finished scene."""

    scene: str = ""
    seconds: Seconds
    cores: Annotated[int, Within(0, 10**6, unit="cores")] = 1
    """Cores that the worker used for it; earlier versions did not say."""
    rejected_attempts: int = 0
    host: str = ""
    pid: int = 0
    finished_unix_s: Seconds
    """Time of completion by the worker's clock."""


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
    row = SceneLog(
        scene=sample_key(scene_index),
        seconds=round(seconds, 3),
        cores=cores,
        rejected_attempts=num_rejected,
        host=socket.gethostname(),
        pid=os.getpid(),
        finished_unix_s=round(time.time(), 1),
    )
    append_line(folder.root / log_name(shard), json.dumps(dataclasses.asdict(row)))


def log_name(shard: str) -> str:
    """Return the name of a shard's log, relative to the dataset."""
    return f"logs/{shard}.jsonl"


def decode_scene_log(text: str) -> Iterator[SceneLog]:
    """Yield the rows of a log; those that a kill has cut are left out."""
    for line in text.splitlines():
        with contextlib.suppress(TrilightError):
            yield read_json(line, SceneLog, "log")


@dataclass(frozen=True, kw_only=True)
class LogSample:
    """Rows and CPU time from a sample of a folder's logs."""

    last: Sequence[SceneLog]
    """The LAST_SCENES that were made last, by time."""
    core_s: float | None
    """Core-seconds of all scenes; where there are more than MOST_LOGS, from as many of them, evenly
    spaced. None without a log."""


def sample_logs(folder: DatasetFolder) -> LogSample:
    """Return what the logs say, reading few of them however many there are."""
    logs = sorted(_logs(folder.logs))
    if not logs:
        return LogSample(last=(), core_s=None)
    # a log that was written before LAST_SCENES others has none of the last scenes
    newest = heapq.nlargest(LAST_SCENES, logs, key=lambda log: log[1])
    rows = sorted(_rows_of(path for path, _ in newest), key=lambda row: row.finished_unix_s)
    spaced = logs[:: -(-len(logs) // MOST_LOGS)]
    core_s = sum(row.seconds * row.cores for row in _rows_of(path for path, _ in spaced))
    return LogSample(last=rows[-LAST_SCENES:], core_s=core_s * len(logs) / len(spaced))


def _rows_of(paths: Iterator[str]) -> Iterator[SceneLog]:
    for path in paths:
        yield from decode_scene_log(Path(path).read_text())


def _logs(folder: Path | str) -> Iterator[tuple[str, int]]:
    """Yield path and time of each log, of the folder and of its parts."""
    for place, _, names in os.walk(folder):
        for path in (os.path.join(place, name) for name in names if name.endswith(".jsonl")):
            yield path, os.stat(path).st_mtime_ns
