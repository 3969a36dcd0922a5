"""Runs that are real in all but objects and pictures: scenes by hand, which cost nothing."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline.executors.threads import ThreadRunner
from pipeline.generation.freeze_objects import ObjectLock
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.generation_run import ShardJob
from pipeline.generation.scene_origins import AcceptedObjects, ComposedScenes
from pipeline.renders.mitsuba_variant import Variant
from storage.dataset.layout import DatasetFolder
from storage.dataset.statistics import Statistics
from storage.records.objects import Failure
from storage.records.sample import Sample, sample_key
from tests.pipeline.generation.test_dataset_writer import LOCKED, _build
from tests.scenes_by_hand import tiny_sample

NO_OBJECTS = AcceptedObjects(
    num_objects=0,
    num_found=0,
    origin=ComposedScenes(lock=Path("none"), index=Path("none"), source="none", licence=None),
)


def tiny_order(**changes: Any) -> GenerateOptions:
    """Return an order that fits the scenes by hand: two views of 16 pixels, four to a shard."""
    return GenerateOptions(**{"resolution": 16, "changes": {"scenes.num_views": 2}, **changes})


def shard_job(root: Path, **changes: Any) -> ShardJob:
    """Return what workers are told of a dataset of tiny scenes without objects."""
    job = ShardJob(
        folder=DatasetFolder(root),
        settings=_build(),
        environment={},
        accepted=NO_OBJECTS,
        lock_sha256="",
        num_at_once=1,
        extensions={},
    )
    return dataclasses.replace(job, **changes)


def without_rendering(
    monkeypatch: pytest.MonkeyPatch, made: Callable[[int], None] = lambda scene: None
) -> list[tuple[str, int]]:
    """Replace objects and pictures; returns a list that fills with split and scene of each made.

    Args:
        monkeypatch: takes it back.
        made: called with each scene as it is made.
    """
    scenes: list[tuple[str, int]] = []

    def freeze(lock: ObjectLock) -> AcceptedObjects:
        if not lock.writer.manifest.objects_lock_sha256:
            lock.writer.lock_objects([LOCKED])
        return dataclasses.replace(NO_OBJECTS, num_found=1)

    def make(split: str, scene: int, *more: Any) -> tuple[Sample, list[Failure]]:
        scenes.append((split, scene))
        made(scene)
        return dataclasses.replace(tiny_sample(seed=scene), key=sample_key(scene)), []

    monkeypatch.setattr(ObjectLock, "accept", freeze)
    monkeypatch.setattr("pipeline.generation.pipeline.make_scene", make)
    without_probe(monkeypatch)
    return scenes


def without_probe(monkeypatch: pytest.MonkeyPatch) -> None:
    """Try no library: nothing is rendered."""
    unprobed = Variant(name="llvm_ad_rgb", libllvm="", note="")
    monkeypatch.setattr("pipeline.renders.mitsuba_variant._on_processor", lambda: unprobed)


class Undocumented(ThreadRunner):
    """Threads, as `trilight generate` uses them; no report is drawn of a finished dataset."""

    def __init__(self) -> None:
        self.finished = 0

    def finish(self, write_documents: Callable[[], Statistics]) -> Any:
        self.finished += 1
