"""All scenes of one shard, each with its attempts, in a borrowed render child; then the shard."""

import json
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

from pipeline.flows.make_scene import MAX_ATTEMPTS, SceneAttempt, attempt_scene
from pipeline.isolation import ChildFailed, IsolatedChild, call_with_retries
from pipeline.shards.pack import pack_shard
from storage.layout import DatasetFolder
from storage.manifest import ShardEntry
from storage.profiles import Profile
from storage.records import Failure
from storage.sample import Sample, sample_key
from storage.splits import SplitSettings, scenes_of_shard, shard_name, split_of_shard
from storage.staging import is_staged, stage_scene


def make_shard(
    folder: DatasetFolder,
    splits: SplitSettings,
    profile: Profile,
    shard_index: int,
    child: IsolatedChild,
) -> ShardEntry:
    """Make what is missing of a shard and pack it.

    Raises:
        TrilightError: the output cannot be written. A scene that cannot be made is not an error:
            its rejections are recorded and the shard goes without it.
    """
    name = shard_name(shard_index, splits)
    staged = folder.staged_shard(name)
    for scene_index in scenes_of_shard(shard_index, splits):
        if is_staged(staged, scene_index):
            continue
        started = time.monotonic()
        split, attempts = split_of_shard(shard_index, splits), _attempts(splits)
        sample, failures = _make_scene(split, scene_index, attempts, child)
        stage_scene(staged, scene_index, sample, failures, profile)
        _log(folder.logs / f"{name}.jsonl", scene_index, time.monotonic() - started, failures)
    return pack_shard(folder, name, scenes_of_shard(shard_index, splits))


def _attempts(splits: SplitSettings) -> int:
    """Return how often a scene may be tried: one that was written down is always the same."""
    return MAX_ATTEMPTS if splits.listed_scenes is None else 1


def _make_scene(
    split: str, scene_index: int, attempts: int, child: IsolatedChild
) -> tuple[Sample | None, list[Failure]]:
    failures: list[Failure] = []
    for attempt in range(attempts):
        outcome = _attempt(split, scene_index, attempt, child)
        failures += outcome.failures
        if outcome.sample:
            return outcome.sample, failures
    return None, failures


def _attempt(split: str, scene_index: int, attempt: int, child: IsolatedChild) -> SceneAttempt:
    try:
        return call_with_retries(child, attempt_scene, split, scene_index, attempt)
    except ChildFailed as failure:
        skipped = Failure(
            stage="renders",
            item=sample_key(scene_index),
            reason="environmental_skip",
            message=str(failure),
            attempt=attempt,
        )
        return SceneAttempt(sample=None, failures=[skipped])


def _log(path: Path, scene_index: int, seconds: float, failures: list[Failure]) -> None:
    """Append what must not be in the dataset: times, hosts, retries."""
    row = {
        "scene": sample_key(scene_index),
        "seconds": round(seconds, 3),
        "rejected_attempts": len(failures),
        "host": socket.gethostname(),
        "pid": os.getpid(),
        "finished_unix_s": round(time.time(), 1),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as stream:
        stream.write(json.dumps(row) + "\n")


def finished_shards(folder: DatasetFolder, splits: SplitSettings, count: int) -> Iterator[str]:
    """Yield the names of the first `count` shards that are there under their final names."""
    names = (shard_name(index, splits) for index in range(count))
    return (name for name in names if folder.shard(name).exists())
