"""Scenes of a shard, each with its attempts, in a borrowed render child; then the shard."""

import logging
import time
from collections.abc import Callable
from pathlib import Path

from pipeline.builds.settings import BuildSettings
from pipeline.isolation import ChildFailed, IsolatedChild, call_with_retries
from pipeline.making.make_scene import MAX_ATTEMPTS, SceneAttempt, attempt_scene
from pipeline.making.pieces import Piece
from pipeline.shards.pack import pack_shard
from storage.claims import claimed
from storage.dataset.layout import DatasetFolder, numbered
from storage.dataset.manifest import ShardEntry
from storage.dataset.splits import scenes_of_shard, shard_name, split_of_shard
from storage.dataset.staging import is_staged, stage_scene
from storage.records.objects import Failure
from storage.records.sample import Sample, sample_key
from storage.settings.dataset import SplitSettings

log = logging.getLogger("trilight.scenes")

_PACKING = "pack.claim"


def make_piece(
    folder: DatasetFolder,
    settings: BuildSettings,
    piece: Piece,
    child: IsolatedChild,
    scene_done: Callable[[int, float, list[Failure]], None],
) -> ShardEntry | None:
    """Make what is missing of a piece, and pack its shard if that is whole then.

    Scenes that somebody else is making are left to them; whoever stages the last one packs.

    Args:
        folder: the dataset.
        settings: of the build.
        piece: the scenes to make.
        child: where they are rendered.
        scene_done: called after each scene that was made here, with its index, its seconds, and
            what was rejected on the way.

    Returns:
        The shard, where this call packed it.

    Raises:
        TrilightError: the output cannot be written. A scene that cannot be made is not an error:
            its rejections are recorded and the shard goes without it.
    """
    name, scenes = _named(piece.shard_index, settings)
    for scene_index in range(piece.first, piece.last):
        if _is_done(folder, name, scene_index):
            continue
        with claimed(_claim(folder, name, scene_index)) as ours:
            if ours and not _is_done(folder, name, scene_index):  # nor in the meantime
                scene_done(
                    scene_index,
                    *_make_and_stage(folder, settings, piece.shard_index, scene_index, child),
                )
    return _packed(folder, name, scenes)


def is_free(folder: DatasetFolder, settings: BuildSettings, shard_index: int) -> bool:
    """Return whether a shard lacks something that nobody is at: a scene, or being packed.

    Whoever wants to claim a scene at the moment of this look may leave it to us: where the answer
    is yes, go and make it.
    """
    name, scenes = _named(shard_index, settings)
    staged = folder.staged_shard(name)
    missing = [index for index in scenes if not is_staged(staged, index)]
    claims = (_claim(folder, name, index) for index in missing)
    if folder.has_shard(name):  # also in the meantime
        return False
    return any(map(_is_unclaimed, claims if missing else [staged / _PACKING]))


def _is_unclaimed(claim: Path) -> bool:
    with claimed(claim) as ours:
        return ours


def _claim(folder: DatasetFolder, name: str, scene_index: int) -> Path:
    return folder.staged_shard(name) / numbered(scene_index, f"{sample_key(scene_index)}.claim")


def _named(shard_index: int, settings: BuildSettings) -> tuple[str, range]:
    splits = settings.splits
    return shard_name(shard_index, splits), scenes_of_shard(shard_index, splits)


def _is_done(folder: DatasetFolder, name: str, scene_index: int) -> bool:
    return folder.has_shard(name) or is_staged(folder.staged_shard(name), scene_index)


def _packed(folder: DatasetFolder, name: str, scenes: range) -> ShardEntry | None:
    """Pack a shard whose scenes are all staged, unless somebody else does."""
    staged = folder.staged_shard(name)
    if folder.has_shard(name) or not all(is_staged(staged, index) for index in scenes):
        return None
    with claimed(staged / _PACKING) as ours:
        if not ours or folder.has_shard(name):
            return None
        shard = pack_shard(folder, name, scenes)
    log.info("%s: packed, %d scenes, %d bytes", name, shard.num_samples, shard.num_bytes)
    return shard


def _make_and_stage(
    folder: DatasetFolder,
    settings: BuildSettings,
    shard_index: int,
    scene_index: int,
    child: IsolatedChild,
) -> tuple[float, list[Failure]]:
    splits, started = settings.splits, time.monotonic()
    name, split = shard_name(shard_index, splits), split_of_shard(shard_index, splits)
    sample, failures = _make_scene(split, scene_index, _attempts(splits), child)
    stage_scene(folder.staged_shard(name), scene_index, sample, failures, settings.storage.profile)
    seconds = time.monotonic() - started
    outcome = "made" if sample else "given up"
    log.info("%s: scene %s %s in %.1f s", name, sample_key(scene_index), outcome, seconds)
    return seconds, failures


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
