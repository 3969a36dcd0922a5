"""Progress of a dataset, from its files alone: counts, rate of the last scenes, time left (ETA).

Any process may read it. The rate is that of the logs, with a row for each scene that is made, in
`logs/<shard>.jsonl`. They hold what must not be in a dataset: times, hosts, retries. Of very many
logs, a look reads those that were written last, and evenly spaced ones that stand for all.
"""

import contextlib
import dataclasses
import functools
import heapq
import itertools
import json
import os
import socket
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from storage.atomic import append_line, write_atomically, write_error
from storage.dataset.dataset import Dataset, open_listed
from storage.dataset.layout import DatasetFolder, numbered_path, shard_names_in
from storage.dataset.manifest import (
    Manifest,
    expected_scenes,
    is_whole,
    listed_scenes,
    planned_shards,
    read_manifest,
)
from storage.dataset.staging import name_of_note, noted_names, noted_shard
from storage.errors import TrilightError
from storage.extensions import is_reference
from storage.records.objects import Failure, count_by_reason
from storage.records.safe_read import read_plain
from storage.records.sample import sample_key
from storage.settings.ranges import Within
from storage.typed_json import T, read_json

_NAME = "logs/asked.json"
"""The words of the command that makes a dataset, so that it can be repeated. The file is no part of
the dataset's identity, names no folder of the dataset, and may be missing."""


def write_asked(folder: DatasetFolder, words: Sequence[str]) -> None:
    """Write down the words after `trilight`, without where the dataset is."""
    write_atomically(folder.root / _NAME, (json.dumps(list(words)) + "\n").encode())


def read_asked(dataset: Dataset) -> list[str] | None:
    """Return what was written down; None where nothing is, or nothing that may be shown.

    The file may come from the dataset's publisher: only words of `generate` that print come back,
    and none that would run a file when they are repeated.
    """
    try:
        words = read_json(dataset.store.get(_NAME) or b"[]", list[str], _NAME)
    except TrilightError:
        return None
    if words[:1] != ["generate"]:
        return None
    harmless = all(
        word.isprintable() and not (is_reference(word) or word.startswith("--extend"))
        for word in words
    )
    return words if harmless else None


def value_of(words: Sequence[str], option: str) -> str | None:
    """Return the word after an option; None where the option is missing."""
    return next((value for name, value in itertools.pairwise(words) if name == option), None)


_AT_WORK_S = 600.0
"""Older notes on unfinished views were left by a kill: a pass of samples takes less time."""


@dataclass(frozen=True, kw_only=True)
class _Counts:
    """Counts of what is finished and of what is planned; 0 planned where it is not known yet."""

    objects_done: int = 0
    """Objects that are prepared or rejected; of a bucket, 0."""
    objects_planned: int = 0
    """Objects to prepare; 0 before they are counted, and of a bucket."""
    scenes_done: int = 0
    """Scenes in shards or waiting for theirs."""
    scenes_given_up: int = 0
    """Scenes that no attempt could save; of a bucket, known once it is finished."""
    scenes_planned: int = 0
    num_views: int = 0


@dataclass(frozen=True, kw_only=True)
class Progress(_Counts):
    """Progress of a dataset in a folder."""

    downloads_done: int
    """Object files that have come from a server, or failed to."""
    downloads_planned: int
    """Object files to fetch; 0 for sources on this machine."""
    views_done: float
    """Views of the finished scenes, and how far those of the scenes at work are."""


def announce_downloads(folder: DatasetFolder, done: int, total: int) -> None:
    """Record how many object files have been downloaded."""
    write_atomically(folder.staged_downloads, json.dumps([done, total]).encode())


def announce_objects(folder: DatasetFolder, num_objects: int) -> None:
    """Record how many objects the asset stage has to do, and that none is done."""
    write_atomically(folder.staged_done, b"")
    write_atomically(folder.staged_plan, json.dumps({"objects": num_objects}).encode())


def count_object(folder: DatasetFolder, count: int = 1) -> None:
    """Record that more objects are prepared or rejected: a byte for each, from any thread."""
    path = folder.staged_done
    try:
        with path.open("ab") as stream:
            stream.write(b"." * count)
    except OSError as error:
        raise write_error(path, error) from error


def count_given_up(folder: DatasetFolder, scene_index: int) -> None:
    """Record that a scene is given up; it only shows progress, so failing to write is no error."""
    with contextlib.suppress(OSError), folder.staged_given_up.open("a") as stream:
        stream.write(f"{scene_index}\n")


def tell_views(folder: DatasetFolder, scene_index: int, views: float | None) -> None:
    """Record how many views of an unfinished scene are done; the current one counts in part.

    None deletes the note: the scene is finished, or starts again. It only shows progress, so
    failing to write it is no error.
    """
    path = folder.staged_at_work / numbered_path(scene_index, f"{scene_index:09d}")
    with contextlib.suppress(OSError):
        if views is None:
            path.unlink()
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{views:.3f}")


def read_progress(folder: DatasetFolder) -> Progress:
    """Count files; cheap enough to be called twice a second: a manifest is read when it changes."""
    counts = _count_objects(folder)
    with contextlib.suppress(TrilightError, OSError):
        facts = folder.manifest.stat()
        manifest, expected = _plan_of(folder.manifest, facts.st_mtime_ns, facts.st_size)
        finished = existing_shards(folder) & set(expected) - set(manifest.growing)
        counts = _count_scenes(counts, manifest, expected, finished, folder)
    done, total = _read_counts(folder.staged_downloads, tuple[int, int], (0, 0))
    return Progress(
        **vars(counts),
        downloads_done=done,
        downloads_planned=total,
        views_done=counts.scenes_done * counts.num_views + _views_at_work(folder),
    )


def _count_objects(folder: DatasetFolder) -> _Counts:
    planned = _read_counts(folder.staged_plan, dict[str, int], {"objects": 0})["objects"]
    done = folder.staged_done.stat().st_size if folder.staged_done.exists() else 0
    # several makers count what all of them found done
    return _Counts(objects_done=min(done, planned), objects_planned=planned)


def _read_counts(path: Path, kind: type[T], none: T) -> T:
    """Return what a file counts, which only shows progress; `none` where it is missing or wrong."""
    with contextlib.suppress(OSError, TrilightError):
        return read_json(read_plain(path), kind, str(path))
    return none


def _views_at_work(folder: DatasetFolder) -> float:
    """Return how many views are in progress, without old notes that a kill has left."""
    since = time.time() - _AT_WORK_S
    views = 0.0
    for path in folder.staged_at_work.rglob("[0-9]*"):
        with contextlib.suppress(OSError, ValueError):  # it is gone, or half written
            if path.is_file() and path.stat().st_mtime > since:
                views += float(path.read_text())
    return views


@functools.lru_cache(maxsize=4)
def _plan_of(path: Path, mtime_ns: int, num_bytes: int) -> tuple[Manifest, Mapping[str, int]]:
    """Return a manifest and its expected scenes, known by the time and size of its file."""
    manifest = read_manifest(path)
    return manifest, expected_scenes(manifest)


def existing_shards(folder: DatasetFolder) -> set[str]:
    """Return the names of the shards that are there under their final names, listed or not."""
    roots = (folder.root, folder.staged_sent) if folder.bucket else (folder.root,)
    return {name for root in roots for name in shard_names_in(root)}


def _finished_names(dataset: Dataset, planned: Collection[str]) -> set[str]:
    """Return the names of the planned shards that are there, listed or not, and do not grow.

    A bucket is asked what it holds, where it may be asked and something is not listed yet: a shard
    is finished there when it and the note on it have come (pipeline.shards.pack_shards).
    """
    if folder := dataset.local:
        return existing_shards(folder) & set(planned) - set(dataset.manifest.growing)
    listed = {entry.name for entry in dataset.manifest.shards} & set(planned)
    unlisted = set(planned) - listed
    names = dataset.names_in_bucket() if unlisted else set()
    return listed | {name for name in unlisted & names if name_of_note(name) in names}


def missing_shards(url: str, num_scenes: int = 0) -> list[int]:
    """Return the indices of the shards that a dataset of any folder or URL lacks.

    Of more scenes than were planned so far, also what those need.

    Where all are there and the dataset is still not finished, its first shard counts as missing:
    the worker that makes it finishes the dataset.

    Raises:
        TrilightError: there is no readable manifest, or the URL is refused.
    """
    dataset = open_listed(url)
    manifest = dataset.manifest
    total_scenes = max(num_scenes, dataset.manifest.num_scenes)
    planned = planned_shards(dataclasses.replace(manifest, num_scenes=total_scenes))
    before = planned_shards(manifest)
    finished = {(name, before.get(name)) for name in _finished_names(dataset, planned)}
    missing = [index for index, shard in enumerate(planned.items()) if shard not in finished]
    return missing or ([] if _is_finished(dataset) else [0])


def _is_finished(dataset: Dataset) -> bool:
    """Return whether every shard is listed, and the documents are there."""
    listed = is_whole(dataset.manifest, len(dataset.manifest.shards))
    return listed and dataset.store.get("README.md") is not None


def _count_scenes(
    counts: _Counts,
    manifest: Manifest,
    expected: Mapping[str, int],
    finished: Collection[str],
    folder: DatasetFolder | None,
) -> _Counts:
    """Return counts with those of scenes; without a folder here, what waits is not known."""
    waiting = given_up = 0
    if folder is not None:
        # first what was given up: a worker counts that after it has staged the scene
        with contextlib.suppress(OSError, ValueError):  # of shards that are not listed, or grow
            scenes = set(map(int, folder.staged_given_up.read_text().split()))
            given_up = len(scenes - listed_scenes(manifest))
        walked = os.walk(folder.staged_samples)  # passes over a folder that is removed meanwhile
        waiting = sum(name.endswith(".tar") for _, _, names in walked for name in names)
    return dataclasses.replace(
        counts,
        scenes_done=sum(expected[name] for name in finished) + waiting - given_up,
        scenes_given_up=given_up + max(manifest.num_scenes - sum(expected.values()), 0),
        scenes_planned=manifest.num_scenes,
        num_views=manifest.num_views,
    )


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


def sample_logs(folder: DatasetFolder) -> tuple[list[SceneLog], float | None]:
    """Return what the logs say, reading few of them however many there are.

    That is the rows of the LAST_SCENES that were made last, by time, and the core-seconds of all
    scenes: where there are more than MOST_LOGS, from as many of them, evenly spaced. They are None
    without a log.
    """
    logs = sorted(_logs(folder.logs))
    if not logs:
        return [], None
    # a log that was written before LAST_SCENES others has none of the last scenes
    newest = heapq.nlargest(LAST_SCENES, logs, key=lambda log: log[1])
    rows = sorted(_rows_of(path for path, _ in newest), key=lambda row: row.finished_unix_s)
    spaced = logs[:: -(-len(logs) // MOST_LOGS)]
    core_s = sum(row.seconds * row.cores for row in _rows_of(path for path, _ in spaced))
    return rows[-LAST_SCENES:], core_s * len(logs) / len(spaced)


def _rows_of(paths: Iterator[str]) -> Iterator[SceneLog]:
    for path in paths:
        yield from decode_scene_log(Path(path).read_text())


def _logs(folder: Path | str) -> Iterator[tuple[str, int]]:
    """Yield path and time of each log, of the folder and of its parts."""
    for place, _, names in os.walk(folder):
        for path in (os.path.join(place, name) for name in names if name.endswith(".jsonl")):
            yield path, os.stat(path).st_mtime_ns


_LOGS_READ = 64
"""Maximum number of logs fetched from a remote dataset, evenly spaced over its shards."""


@dataclass(frozen=True, kw_only=True)
class DatasetStatus(_Counts):
    """Status of a dataset, finished or not."""

    display_name: str
    """Path or URL without secrets."""
    build: str
    shards_done: int
    """Finished shards, listed in the manifest or not."""
    shards_planned: int
    shards_lost: int
    """Shards that a finished dataset lists, and that are not there; of a bucket, 0."""
    finished: bool
    """Every shard is listed, and the documents are there."""
    at_work: bool
    """A process is making it now, as far as its locks reach; of a bucket, False."""
    views_per_hour: float | None
    """Rate over the last scenes; of a remote dataset over all scenes, pauses included. None without
    enough log rows, and of a finished dataset."""
    remaining_s: float | None
    """Time until all scenes are made at that rate."""
    core_hours: float | None
    """Core hours spent on finished scenes; killed workers are not counted. Of very many logs, some
    stand for all. None without logs."""
    last_scene_unix_s: float | None
    failures: Sequence[tuple[str, str, int]]
    """Stage, reason and number of rejections, the most frequent first. While a dataset is made,
    those of a folder's last shards alone where there are very many (MOST_NOTES)."""
    digest: str
    """The dataset digest; empty while it is made."""
    extensions: Mapping[str, str]
    """The sha256 of each extension that it was begun with, by its name."""
    asked: Sequence[str] | None
    """Words of the command that makes the dataset, without its location; None if not recorded."""

    @property
    def next_words(self) -> Sequence[str] | None:
        """The words of the command to run next, if it is known."""
        if self.finished:
            return ("verify", self.display_name, *(["--repair"] if self.shards_lost else []))
        return None if self.asked is None else (*self.asked, "--out", self.display_name)


def read_status(url: str) -> DatasetStatus:
    """Return the status of a dataset; raises as `missing_shards`."""
    dataset = open_listed(url)
    manifest = dataset.manifest
    local = dataset.local
    planned = expected_scenes(manifest)
    names = _finished_names(dataset, planned)
    objects = _count_objects(local) if local else _Counts()
    counts = _count_scenes(objects, manifest, planned, names, local)
    last, core_s, share = (*sample_logs(local), 1.0) if local else _sampled_logs(dataset)
    finished = _is_finished(dataset)
    listed = [entry.name for entry in manifest.shards]
    scenes_left = counts.scenes_planned - counts.scenes_done - counts.scenes_given_up
    views_per_hour, remaining_s = _rate(last, share, manifest, 0 if finished else scenes_left)
    return DatasetStatus(
        **vars(counts),
        display_name=dataset.display_name,
        build=manifest.build,
        shards_done=len(names),
        shards_planned=len(planned),
        shards_lost=len(listed) - len(_finished_names(dataset, listed)) if finished else 0,
        finished=finished,
        at_work=local is not None and local.is_at_work,
        views_per_hour=views_per_hour,
        remaining_s=remaining_s,
        core_hours=None if core_s is None else core_s / 3600,
        last_scene_unix_s=last[-1].finished_unix_s if last else None,
        failures=count_by_reason([*dataset.failures(), *(_noted_failures(local) if local else ())]),
        digest=dataset.digest if finished else "",
        extensions=manifest.extensions,
        asked=read_asked(dataset),
    )


MOST_NOTES = 4096
"""Maximum number of notes that are read for the rejections of a dataset that is made."""


def _noted_failures(folder: DatasetFolder) -> list[Failure]:
    """Return what was rejected on the way to shards that are not listed yet."""
    names = sorted(noted_names(folder))[-MOST_NOTES:]
    notes = (noted_shard(folder, name) for name in names if folder.shard(name).exists())
    return [failure for note in notes for failure in note.failures]


def _sampled_logs(dataset: Dataset) -> tuple[list[SceneLog], float | None, float]:
    """Return what logs on a server say, and of what share of the listed scenes they are.

    A sample of the logs stands for all; where the first is missing, the dataset has none.
    """
    shards = dataset.manifest.shards
    rows: list[SceneLog] = []
    scenes = 0
    for entry in shards[:: -(-len(shards) // _LOGS_READ)] if shards else ():
        data = dataset.store.get(log_name(entry.name))
        if data is None and not rows:
            break
        if data is not None:
            rows += decode_scene_log(data.decode(errors="replace"))
            scenes += entry.num_samples
    share = scenes / max(dataset.manifest.num_samples, 1)
    core_s = sum(row.seconds * row.cores for row in rows) / share if share else None
    rows.sort(key=lambda row: row.finished_unix_s)
    return rows, core_s, share


def _rate(
    last: Sequence[SceneLog], fraction: float, manifest: Manifest, scenes_left: int
) -> tuple[float | None, float | None]:
    """Return views per hour and seconds left, from rows by time that are a share of the scenes."""
    if scenes_left <= 0 or len(last) < 2:
        return None, 0.0 if scenes_left <= 0 else None
    # from the start of the first to the end of the last, over all who worked at the same time
    span_s = last[-1].finished_unix_s - (last[0].finished_unix_s - last[0].seconds)
    per_s = len(last) / fraction / max(span_s, 1e-3)
    return 3600 * per_s * manifest.num_views, scenes_left / per_s
