"""Predicts time, bytes and cost of a dataset from a few scenes measured on this machine.

Scenes differ in cost by orders of magnitude (a hard view takes a hundred times the samples of an
easy one), so that a mean of few scenes has a wide interval, which is computed by the bootstrap. The
measured scenes are the first ones of the dataset, in its shards and splits.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.generation_run import MAX_TASKS, TASK_S, Piece
from pipeline.generation.pipeline import make_task, prepare_dataset
from pipeline.generation.render_workers import close_children
from pipeline.presets.settings import DatasetSettings
from pipeline.renders.mitsuba_variant import visible_gpus
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import read_manifest
from storage.dataset.progress import read_progress, sample_logs
from storage.dataset.shard import open_shard
from storage.dataset.splits import (
    keeps_scenes,
    lacks_validation,
    planned_scenes,
    shard_name,
    shards_for,
)
from storage.dataset.staging import read_staged_scene
from storage.machine import available_cores
from storage.records.sample import sample_key
from storage.seeds import rng_for

_DRAWS = 2000
_BYTES_PER_TASK_RUN = 19_400
"""Bytes in Prefect's database: states, events and indices (study S58)."""
_BYTES_PER_SHARD = 180
"""Bytes of a row of the manifest: 172 for train-000123.tar, 178 for one in a subfolder."""
_LONG_TASK_MINUTES = 10
_VIEW_CORE_S = (38.0, 5.5), (46.0, 15.5)
"""CPU seconds of a view of 256 pixels at two noise targets in dB: `make dataset`, and study S36."""


@dataclass(frozen=True, kw_only=True)
class Interval:
    """Predicted figure with its 90 % interval."""

    value: float
    low: float
    """5th percentile of the bootstrap."""
    high: float
    """95th percentile of the bootstrap."""

    def to_text(self, form: Callable[[float], str]) -> str:
        """Return the figure and its interval, each formatted by `form`."""
        return f"{form(self.value)} ({form(self.low)} to {form(self.high)})"


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Predicted size and cost of a dataset."""

    num_scenes: int
    num_shards: int
    scenes_per_shard: int
    """Number of scenes in each shard but the last, which may have fewer."""
    core_hours: Interval
    hours: Interval
    """Wall-clock hours with all cores busy."""
    usd: Interval
    gigabytes: Interval
    """Size of all shards in 10^9 bytes."""
    shard_hours: Interval
    num_tasks: int
    """Number of task runs in one flow run that makes the whole dataset."""
    task_minutes: float
    """Wall-clock minutes of a task on this machine's cores."""
    database_mb: float
    """Size of the task runs in Prefect's database in 10^6 bytes."""
    manifest_mb: float
    """Size of the finished manifest.json in 10^6 bytes."""
    notes: tuple[str, ...]


def measure_scenes(
    options: GenerateOptions, count: int, place: Path, scene_done: Callable[[], None]
) -> list[tuple[float, int]]:
    """Make the first scenes of a dataset in another folder.

    Args:
        options: options of the dataset, whose folder is not touched.
        place: empty folder, which may be deleted afterwards.

    Returns:
        CPU seconds of each scene, and its bytes in its shard, in the order of rendering.

    Raises:
        TrilightError: as `prepare_dataset`.
    """
    # prepared at its full size, so that a lack of objects is reported now and not by `generate`
    scenes = max(count, options.num_scenes)
    run = prepare_dataset(dataclasses.replace(options, out=str(place), scenes=scenes))
    job = dataclasses.replace(run.job, num_at_once=1)
    splits = job.settings.splits
    measured = []
    try:
        for scene in range(count):
            shard = scene // splits.scenes_per_shard
            made = make_task(job, (Piece(shard_index=shard, first=scene, last=scene + 1),))
            num_bytes = _scene_bytes(job.folder, shard_name(shard, splits), scene)
            measured.append((made.core_s, num_bytes))
            scene_done()
    finally:
        close_children()
    return measured


def predict_cost(
    measured: Sequence[tuple[float, int]],
    options: GenerateOptions,
    *,
    cores: int,
    usd_per_core_hour: float,
) -> Prediction:
    """Return the predicted cost of the whole dataset from the means of measured scenes.

    The first scene of a process also compiles kernels, which a long run does once per 200 scenes;
    it is left out if there are others. Means are resampled 2000 times (Efron's bootstrap), which is
    too narrow for very few scenes and cannot predict costs that none of them shows.
    """
    splits = options.settings.splits
    num_scenes = planned_scenes(options.num_scenes, splits)
    num_shards = shards_for(num_scenes, splits)
    core_s, num_bytes = zip(*measured, strict=True)
    core_hours = _total(core_s[1:] or core_s, num_scenes / 3600)
    scene_s = core_hours.value * 3600 / num_scenes / available_cores()
    num_tasks = min(MAX_TASKS, max(1, math.ceil(num_scenes * scene_s / TASK_S)))
    task_minutes = num_scenes * scene_s / num_tasks / 60
    notes = []
    if task_minutes > _LONG_TASK_MINUTES:
        parts = math.ceil(task_minutes / _LONG_TASK_MINUTES)
        notes.append(
            f"one flow run would have tasks of {task_minutes:.0f} minutes: let build-dataset make "
            f"it in at least {parts} flow runs, on as many workers"
        )
    return Prediction(
        num_scenes=num_scenes,
        num_shards=num_shards,
        scenes_per_shard=splits.scenes_per_shard,
        core_hours=core_hours,
        hours=_scale(core_hours, 1 / cores),
        usd=_scale(core_hours, usd_per_core_hour),
        gigabytes=_total(num_bytes, num_scenes / 1e9),
        shard_hours=_scale(core_hours, 1 / num_shards),
        num_tasks=num_tasks,
        task_minutes=task_minutes,
        database_mb=num_tasks * _BYTES_PER_TASK_RUN / 1e6,
        manifest_mb=num_shards * _BYTES_PER_SHARD / 1e6,
        notes=tuple(notes),
    )


def describe_run(options: GenerateOptions, folder: DatasetFolder) -> str:
    """Return a line on the scenes that a run will make, and its time by earlier scenes.

    It is empty if files or another dataset define the scenes.
    """
    settings = options.settings
    if options.scenes_from or options.revisits or settings.revisit:
        return ""
    scenes = options.num_scenes
    remaining = scenes
    core_s: list[float] = []
    size = size_note = ""
    if folder.manifest.exists():
        manifest = read_manifest(folder.manifest)
        last, _ = sample_logs(folder)
        size_note = keeps_scenes(manifest.num_scenes, options.scenes, settings.splits)
        scenes = max(scenes, manifest.num_scenes)
        remaining = max(scenes - read_progress(folder).scenes_done, 0)
        core_s = [row.seconds * row.cores for row in last]
        if sizes := [
            each.num_bytes / each.num_samples for each in manifest.shards if each.num_samples
        ]:
            size = f", about {_total(sizes, scenes / 1e6).value:,.1f} MB"
    shards = shards_for(scenes, settings.splits)
    lacking = lacks_validation(scenes, settings.splits)
    notes = "".join(f" ({text})" for text in (size_note, lacking) if text)
    part = f", of which this run makes {options.shards}" if options.shards else ""
    views = f"{settings.scenes.num_views} views each"
    counts = f"{_count_text(scenes, 'scene')} of {views} in {_count_text(shards, 'shard')}"
    return f"{counts}{notes}{part}{size}; {_expected_time(settings, remaining, core_s)}"


def _expected_time(settings: DatasetSettings, remaining: int, core_s: Sequence[float]) -> str:
    """Return about how long the remaining scenes take, by earlier ones of the set or by ours."""
    cores = available_cores()
    on_cores = f"on {_count_text(cores, 'core')}"
    if core_s:
        minutes = _total(core_s, remaining / cores / 60).to_text("{:,.1f}".format)
        return f"{remaining} of them are still to make: {minutes} minutes {on_cores}"
    if visible_gpus():
        return "how long that takes is known after the first scenes"
    (low_db, low_s), (high_db, high_s) = _VIEW_CORE_S
    target_db = settings.renders.targets_db.get("psnr_log_db", low_db)
    power = (target_db - low_db) / (high_db - low_db)
    pixels = (settings.renders.resolution / 256) ** 2
    views = remaining * settings.scenes.num_views
    hours = views * pixels * low_s * (high_s / low_s) ** power / cores / 3600
    said = f"{hours:,.0f} hours" if hours > 2 else _count_text(math.ceil(60 * hours), "minute")
    return (
        f"once objects are prepared, roughly {said} {on_cores}, where scenes cost what ours did; "
        "`trilight plan` measures it"
    )


def _count_text(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def _scene_bytes(folder: DatasetFolder, shard: str, scene: int) -> int:
    """Return the bytes of a scene in its shard: a header for each member, and blocks of 512 bytes.

    The last scene of a shard is packed already; the others are still staged.
    """
    if folder.shard(shard).exists():
        with open_shard(folder.shard(shard)) as opened:
            members = opened.samples.get(sample_key(scene), {})
        sizes = [member.num_bytes for member in members.values()]
    else:
        staged, _ = read_staged_scene(folder.staged_shard(shard), scene)
        sizes = [len(member) for member in staged.values()]
    return sum(512 + -(-num_bytes // 512) * 512 for num_bytes in sizes)


def _total(each: Sequence[float], times: float) -> Interval:
    """Return the mean of some scenes times a factor, with a bootstrap interval."""
    values = np.asarray(each, np.float64)
    rows = rng_for(0, "plan").integers(0, len(values), (_DRAWS, len(values)))
    means: NDArray[np.float64] = values[rows].mean(axis=1) * times
    low, high = np.percentile(means, [5, 95])
    return Interval(value=float(values.mean()) * times, low=float(low), high=float(high))


def _scale(interval: Interval, by: float) -> Interval:
    return Interval(value=interval.value * by, low=interval.low * by, high=interval.high * by)
