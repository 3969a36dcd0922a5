"""The records of a run that the steps of `pipeline.making.pipeline` hand on to each other."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.builds.named import BUILDS, frozen_note, named_build, object_source
from pipeline.builds.settings import BuildSettings
from pipeline.exchange.scene_folder import SceneFolder, find_scene_files
from pipeline.making.accept_revisited import settings_for_revisit
from pipeline.making.accept_scene_files import settings_for_files
from pipeline.making.bucket_publication import begin_dataset
from pipeline.making.dataset_order import DatasetOrder
from pipeline.making.environment import environment
from pipeline.making.freeze_objects import AcceptedObjects
from pipeline.making.machine import children_of_gpu, gpu_memory_bytes, visible_gpus
from pipeline.making.publication import Publication
from pipeline.objects.sources import look_at_source
from pipeline.renders.variant import choose_variant
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, ShardEntry
from storage.dataset.splits import lacks_validation
from storage.dataset.statistics import Statistics
from storage.errors import TrilightError
from storage.records.objects import Failure


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """A dataset that is begun, with its objects frozen: what every later step needs."""

    order: DatasetOrder
    """What was asked for."""
    settings: BuildSettings
    """The build with the order's changes."""
    listed: SceneFolder | None
    """The scene files, where scenes come from files."""
    publication: Publication
    """What is public of the dataset."""
    accepted: AcceptedObjects
    """What scenes are made of."""

    def missing_shards(self) -> list[int]:
        """Return the numbers of the shards that were asked for and are not there."""
        return self.publication.missing_shards(self.order.shard_range())

    def num_workers(self) -> int:
        """Return how many tasks run at a time in one process, where the executor does not say."""
        if self.order.workers is not None:
            return self.order.workers
        if choose_variant().name != "cuda_ad_rgb":
            return 1
        num_gpus = max(1, len(visible_gpus()))
        return num_gpus * children_of_gpu(self.settings.renders.resolution, gpu_memory_bytes())

    def job(self, num_at_once: int) -> "ShardJob":
        """Return what the tasks of this run share, `num_at_once` of them in one process."""
        manifest = self.publication.manifest
        return ShardJob(
            folder=self.publication.folder,
            settings=self.settings,
            environment={} if self.order.accept_environment else manifest.environment,
            accepted=self.accepted,
            lock_sha256=manifest.objects_lock_sha256,
            num_at_once=num_at_once,
            extensions=manifest.extensions,
        )

    def outcome(self, finished: Manifest | None, statistics: Statistics | None) -> "Outcome":
        """Return what the run leaves behind, of a finished dataset with what it holds."""
        publication, listed = self.publication, self.listed
        notes: tuple[str, ...] = ()
        if listed and self.accepted.files:
            notes = (*self.accepted.files.notes, *listed.notes(self.settings.scenes.num_views))
        elif statistics and self.order.revisits is None:
            notes = frozen_note(self.order.build, statistics)
            splits, num_scenes = self.settings.splits, publication.manifest.num_scenes
            if lacking := lacks_validation(num_scenes, splits):
                notes += (lacking,)
        return Outcome(
            digest=finished.dataset_digest if finished else "",
            num_objects_found=self.accepted.num_found,
            num_objects_used=self.accepted.num_objects,
            num_scenes_given_up=publication.done.given_up,
            failures=tuple(publication.failures),
            num_shards=len(finished.shards) if finished else publication.num_shards_there(),
            num_shards_planned=publication.num_shards,
            statistics=statistics,
            notes=notes,
        )

    def require_within_budget(self) -> None:
        """Raise TrilightError where too many scenes failed: in this run, in the end in all.

        Scene files of which nothing can be made do not count.
        """
        publication, files = self.publication, self.accepted.files
        num_scenes, budget = publication.manifest.num_scenes, self.order.failure_budget
        given_up = publication.done.given_up
        if given_up > budget * num_scenes + (len(files.unusable) if files else 0):
            publication.add_failures(publication.failures)
            raise TrilightError(
                f"{publication.folder.shown}: {given_up} of {num_scenes} scenes could not be made, "
                f"more than the failure budget of {budget:.0%}. The reasons are in "
                f"{publication.folder.failures.name}; mend them, or raise --failure-budget."
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class ShardJob:
    """What the tasks of a run share; it may travel to another machine of the same kind."""

    folder: DatasetFolder
    """The dataset, at the same place on every machine."""
    settings: BuildSettings
    """The build."""
    environment: Mapping[str, Any]
    """What the dataset was begun with, which every maker must have too; empty to accept any."""
    accepted: AcceptedObjects
    """What scenes are made of; prepared files are in the user's cache, or are made there again."""
    lock_sha256: str
    """Digest of the frozen objects."""
    num_at_once: int
    """Tasks at a time in one process; they share its cores."""
    extensions: Mapping[str, str]
    """What the dataset was begun with, which every maker must have loaded (storage.extensions)."""


@dataclass(frozen=True, kw_only=True)
class TaskOutcome:
    """What a task has made."""

    shards: tuple[ShardEntry, ...]
    """The shards that it packed."""
    scenes: int
    """Scenes that it made or gave up; others were there, or are made elsewhere."""
    seconds: float
    """Wall time."""
    core_s: float
    """The same times the cores of the render child."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """What a run leaves behind."""

    digest: str
    """The dataset digest; empty where the dataset is not finished."""
    num_objects_found: int
    """Objects in the source, or the files that scenes are made of."""
    num_objects_used: int
    """Objects that scenes may draw from."""
    num_scenes_given_up: int
    """Scenes that no attempt could save; of this run alone where the dataset is not finished."""
    failures: tuple[Failure, ...]
    """What was rejected in this run and is not in `failures.jsonl` yet."""
    num_shards: int
    """Shards that are there, as far as is known here."""
    num_shards_planned: int
    """Shards of the finished dataset."""
    statistics: Statistics | None
    """What the dataset holds; None where it is not finished, or another machine, which has finished
    it, writes its documents."""
    notes: tuple[str, ...] = ()
    """What a person should know: fields of scene files that are unknown, cameras that were not
    used, and whether a frozen set is the published one."""


Watcher = Callable[[Run, TaskOutcome], None]
"""Called after each task."""


def settings_of(
    order: DatasetOrder, folder: DatasetFolder
) -> tuple[BuildSettings, SceneFolder | None]:
    """Return the settings of an order, and the scene files if scenes come from files.

    Raises:
        TrilightError: the settings contradict each other, or the source or the files are unusable.
    """
    settings = named_build(
        order.build,
        seed=order.seed,
        resolution=order.resolution,
        noise_floor_db=order.noise_floor_db,
        noise_floor_linear_db=order.noise_floor_linear_db,
        noise_floor_objects_db=order.noise_floor_objects_db,
        allow_licences=order.allow_licences,
        changes=order.changes,
    )
    if order.revisits is not None or settings.revisit is not None:
        return settings_for_revisit(settings, order.revisits), None
    source = object_source(settings, order.objects)
    files = order.scenes_from
    listed = None if files is None else find_scene_files(files, order.albedo_over_one)
    if listed is None and not folder.manifest.exists():
        look_at_source(source, allowed_licences=settings.allowed_licences, licence=order.licence)
    return settings_for_files(settings, listed, order.views), listed


def begun_publication(
    order: DatasetOrder, settings: BuildSettings, folder: DatasetFolder
) -> Publication:
    """Begin the dataset of an order, or go on with the one that is there.

    Raises:
        TrilightError: the dataset was begun otherwise, has not got the shards of the order, or
            cannot be rendered here.
    """
    variant = choose_variant()
    publication = begin_dataset(
        folder,
        settings,
        environment(variant),
        BUILDS[order.build].num_scenes if order.scenes is None else order.scenes,
        accept_environment=order.accept_environment,
    )
    wanted = order.shard_range()
    if wanted is not None and wanted.start >= publication.num_shards:
        raise TrilightError(
            f"shards is {order.shards!r}; expected one that begins below {publication.num_shards}, "
            f"the shards of {publication.manifest.num_scenes} scenes."
        )
    return publication
