"""Predicts what a dataset will take from a few scenes measured on this machine.

Scenes differ in cost by orders of magnitude (a hard view takes a hundred times the samples of an
easy one), so a mean of few has a wide interval: it is the bootstrap's, from the measured scenes.
The scenes are the first ones of the dataset itself, in its own shards and splits.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.builds.named import BUILDS, named_build
from pipeline.builds.settings import BuildSettings
from pipeline.making.dataset_order import DatasetOrder
from pipeline.making.machine import cores_owned
from pipeline.making.pipeline import make_task, prepare_dataset
from pipeline.making.render_children import close_children
from pipeline.making.tasks import MOST_TASKS, TASK_S, Piece
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import read_manifest
from storage.dataset.progress import read_progress
from storage.dataset.scene_logs import look_at_logs
from storage.dataset.shard import contents_of
from storage.dataset.splits import lacks_validation, planned_scenes, shard_name, shards_for
from storage.dataset.staging import read_staged_scene
from storage.records.safe_read import open_plain
from storage.records.sample import sample_key
from storage.seeds import rng_for

_DRAWS = 2000
_BYTES_PER_TASK_RUN = 19_400
"""Bytes in Prefect's database: states, events and indices (study S58)."""
_BYTES_PER_SHARD = 180
"""Bytes of a row of the manifest: 172 of train-000123.tar, 178 of one in a part of the folder."""
_LONG_TASK_MINUTES = 10


@dataclass(frozen=True, kw_only=True)
class Interval:
    """A figure with its 90 % interval, as far as few scenes can tell."""

    value: float
    """What to expect."""
    low: float
    """5th percentile."""
    high: float
    """95th percentile."""

    def shown(self, form: Callable[[float], str]) -> str:
        """Return the figure and its interval, each as `form` writes it."""
        return f"{form(self.value)} ({form(self.low)} to {form(self.high)})"


@dataclass(frozen=True, kw_only=True)
class MeasuredScenes:
    """What some scenes took."""

    core_s: tuple[float, ...]
    """Core-seconds of each, in the order in which they were made."""
    num_bytes: tuple[int, ...]
    """Bytes of each, in the same order."""
    num_views: int
    """Views of a scene."""


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """What a dataset will take."""

    num_scenes: int
    """Scenes."""
    num_shards: int
    """Shards."""
    scenes_per_shard: int
    """Scenes in each but the last, which may have fewer."""
    core_hours: Interval
    """Cores times hours."""
    hours: Interval
    """On the whole fleet, all of whose cores are busy."""
    usd: Interval
    """What the cores cost."""
    gigabytes: Interval
    """All shards."""
    shard_hours: Interval
    """Core-hours of one shard."""
    num_tasks: int
    """Task runs of one flow run that makes everything."""
    task_minutes: float
    """How long one takes on one of the machines' render processes."""
    database_mb: float
    """Rows of those task runs in Prefect's database."""
    manifest_mb: float
    """Size of manifest.json when all is done."""
    notes: tuple[str, ...]
    """Warnings before the dataset is begun."""


def measure_scenes(
    order: DatasetOrder, count: int, place: Path, scene_done: Callable[[], None]
) -> MeasuredScenes:
    """Make the first scenes of a dataset in another folder.

    Args:
        order: the dataset; its folder is not touched.
        count: scenes to make.
        place: an empty folder, which may be deleted then.
        scene_done: called after each.

    Raises:
        TrilightError: as `prepare_dataset`.
    """
    # begun as large as it will be, so that a lack of objects is reported now and not by `generate`
    scenes = max(count, _num_scenes(order))
    run = prepare_dataset(dataclasses.replace(order, out=str(place), scenes=scenes))
    job = run.job(1)
    splits = run.settings.splits
    core_s = []
    sizes = []
    try:
        for scene in range(count):
            shard = scene // splits.scenes_per_shard
            made = make_task(job, (Piece(shard_index=shard, first=scene, last=scene + 1),))
            core_s.append(made.core_s)
            sizes.append(_scene_bytes(job.folder, shard_name(shard, splits), scene))
            scene_done()
    finally:
        close_children()
    return MeasuredScenes(
        core_s=tuple(core_s), num_bytes=tuple(sizes), num_views=run.settings.scenes.num_views
    )


def predict(
    measured: MeasuredScenes, order: DatasetOrder, *, cores: int, usd_per_core_hour: float
) -> Prediction:
    """Return what the whole dataset will take, by the means of the measured scenes.

    The first scene of a process also compiles kernels, which a long run does once per 200 scenes;
    it is left out where there are others. Means are resampled 2000 times (Efron's bootstrap), which
    is too narrow for very few scenes and cannot know what none of them shows.
    """
    splits = _settings(order).splits
    num_scenes = planned_scenes(_num_scenes(order), splits)
    num_shards = shards_for(num_scenes, splits)
    core_hours = _total(measured.core_s[1:] or measured.core_s, num_scenes / 3600)
    scene_s = core_hours.value * 3600 / num_scenes / cores_owned()
    num_tasks = min(MOST_TASKS, max(1, math.ceil(num_scenes * scene_s / TASK_S)))
    found = Prediction(
        num_scenes=num_scenes,
        num_shards=num_shards,
        scenes_per_shard=splits.scenes_per_shard,
        core_hours=core_hours,
        hours=_scaled(core_hours, 1 / cores),
        usd=_scaled(core_hours, usd_per_core_hour),
        gigabytes=_total(measured.num_bytes, num_scenes / 1e9),
        shard_hours=_scaled(core_hours, 1 / num_shards),
        num_tasks=num_tasks,
        task_minutes=num_scenes * scene_s / num_tasks / 60,
        database_mb=num_tasks * _BYTES_PER_TASK_RUN / 1e6,
        manifest_mb=num_shards * _BYTES_PER_SHARD / 1e6,
        notes=(),
    )
    return dataclasses.replace(found, notes=tuple(_notes(found)))


def describe_run(order: DatasetOrder, folder: DatasetFolder) -> str:
    """Return what a run is going to make, and how long it takes as far as earlier scenes tell.

    Empty where files or another dataset say which scenes there are.
    """
    settings = _settings(order)
    if order.scenes_from or order.revisits or settings.revisit:
        return ""
    scenes = _num_scenes(order)
    said = "; how long that takes is known after the first scenes"
    if folder.manifest.exists():
        manifest = read_manifest(folder.manifest)
        last = look_at_logs(folder).last
        scenes = max(scenes, manifest.num_scenes)
        left = max(scenes - read_progress(folder).scenes_done, 0)
        cores = cores_owned()
        if last:
            core_s = [row.seconds * row.cores for row in last]
            minutes = _total(core_s, left / cores / 60).shown("{:,.1f}".format)
            said = f"; {left} of them are still to make: {minutes} minutes on {cores} cores"
        if sizes := [
            each.num_bytes / each.num_samples for each in manifest.shards if each.num_samples
        ]:
            said = f", about {_total(sizes, scenes / 1e6).value:,.1f} MB{said}"
    shards = shards_for(scenes, settings.splits)
    lacking = lacks_validation(scenes, settings.splits)
    lacking = f" ({lacking})" if lacking else ""
    part = f", of which this run makes {order.shards}" if order.shards else ""
    views = f"{settings.scenes.num_views} views each"
    counts = f"{_counted(scenes, 'scene')} of {views} in {_counted(shards, 'shard')}"
    return f"{counts}{lacking}{part}{said}"


def _counted(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def _notes(found: Prediction) -> Iterator[str]:
    if found.task_minutes > _LONG_TASK_MINUTES:
        parts = math.ceil(found.task_minutes / _LONG_TASK_MINUTES)
        yield (
            f"one flow run would have tasks of {found.task_minutes:.0f} minutes: let build-dataset "
            f"make it in at least {parts} flow runs, on as many workers"
        )


def _num_scenes(order: DatasetOrder) -> int:
    return BUILDS[order.build].num_scenes if order.scenes is None else order.scenes


def _settings(order: DatasetOrder) -> BuildSettings:
    return named_build(
        order.build,
        resolution=order.resolution,
        noise_floor_db=order.noise_floor_db,
        noise_floor_linear_db=order.noise_floor_linear_db,
        noise_floor_objects_db=order.noise_floor_objects_db,
        changes=order.changes,
    )


def _scene_bytes(folder: DatasetFolder, shard: str, scene: int) -> int:
    """Return what a scene adds to its shard: a header for each member, its bytes in blocks of 512.

    The last scene of a shard is packed already, and the others wait for it.
    """
    if folder.shard(shard).exists():
        with open_plain(folder.shard(shard)) as stream:
            members = contents_of(stream, shard).samples.get(sample_key(scene), {})
        sizes = [member.num_bytes for member in members.values()]
    else:
        staged = read_staged_scene(folder.staged_shard(shard), scene)
        sizes = [len(member) for member in staged.members.values()]
    return sum(512 + -(-num_bytes // 512) * 512 for num_bytes in sizes)


def _total(each: Sequence[float], times: float) -> Interval:
    """Return the mean of some scenes times a number, with a bootstrap interval."""
    values = np.asarray(each, np.float64)
    rows = rng_for(0, "plan").integers(0, len(values), (_DRAWS, len(values)))
    means: NDArray[np.float64] = values[rows].mean(axis=1) * times
    low, high = np.percentile(means, [5, 95])
    return Interval(value=float(values.mean()) * times, low=float(low), high=float(high))


def _scaled(interval: Interval, by: float) -> Interval:
    return Interval(value=interval.value * by, low=interval.low * by, high=interval.high * by)
