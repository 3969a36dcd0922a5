"""`Run` and other records that the steps of `pipeline.generation.pipeline` pass to each other."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.exchange.scene_files import SceneFiles, SceneFolder, find_scene_files
from pipeline.generation.accept_revisited import settings_for_revisit
from pipeline.generation.accept_scene_files import settings_for_files
from pipeline.generation.dataset_writer import DatasetWriter
from pipeline.generation.freeze_objects import AcceptedObjects
from pipeline.generation.generate_options import GenerateOptions
from pipeline.objects.sources import check_source
from pipeline.presets.registry import DATASET_PRESETS, frozen_note, object_source, preset_settings
from pipeline.presets.settings import DatasetSettings
from pipeline.renders.mitsuba_variant import Device, Variant, choose_variant, device_of
from pipeline.renders.visible_gpus import gpu_memory_bytes, visible_gpus
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, ShardEntry, read_head
from storage.dataset.splits import keeps_scenes, lacks_validation
from storage.dataset.statistics import Statistics
from storage.errors import TrilightError
from storage.records.objects import Failure

_MOST_CHILDREN = 4
"""Children of a GPU. One that only renders fills an H200 (60,700 views an hour, four 58,500), but a
child also composes, checks and encodes on the CPU meanwhile."""

_CHILD_BYTES = 1 << 30
"""GPU memory of a render child; four used 4.6 GB in all on an H200."""

_PIXEL_BYTES = 2400
"""More of it for each pixel: a pass of 64 samples, which Dr.Jit rounds up to powers of two."""

_USED = 0.9
"""Fraction of a GPU's memory that render children may fill."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """A dataset that has begun, with its objects frozen: the input of every later step."""

    options: GenerateOptions
    """The command's options."""
    settings: DatasetSettings
    """The preset with the options' changes."""
    scene_folder: SceneFolder | None
    """The scene files, where scenes come from files."""
    publication: DatasetWriter
    """Writes the manifest and publishes finished shards."""
    accepted: AcceptedObjects
    """The frozen objects, textures, skies or scene files that scenes are made of."""
    device: Device = "cpu"
    """Device that renders, `cpu` or `gpu`."""

    def unfinished_shards(self) -> list[int]:
        """Return the numbers of the requested shards that are not finished."""
        return self.publication.unfinished_shards(self.options.shard_range())

    def num_workers(self) -> int:
        """Return the number of parallel tasks of one process; an executor may set another."""
        if self.options.workers is not None:
            return self.options.workers
        if self.device == "cpu":
            return 1
        num_gpus = max(1, len(visible_gpus()))
        return num_gpus * children_of_gpu(self.settings.renders.resolution, gpu_memory_bytes())

    def job(self, num_at_once: int) -> "ShardJob":
        """Return the job that all tasks of this run share; one process runs `num_at_once` tasks."""
        manifest = self.publication.manifest
        return ShardJob(
            folder=self.publication.folder,
            settings=self.settings,
            environment={} if self.options.accept_environment else manifest.environment,
            accepted=self.accepted,
            lock_sha256=manifest.objects_lock_sha256,
            num_at_once=num_at_once,
            extensions=manifest.extensions,
            device=self.device,
        )

    def outcome(self, finished: Manifest | None, statistics: Statistics | None) -> "Outcome":
        """Return the result of the run; a finished dataset adds its digest and statistics."""
        writer = self.publication
        listed = self.scene_folder
        notes: tuple[str, ...] = ()
        origin = self.accepted.origin
        if listed and isinstance(origin, SceneFiles):
            notes = (*origin.notes, *listed.notes(self.settings.scenes.num_views))
        elif statistics and self.options.revisits is None:
            notes = frozen_note(self.options.build, statistics)
            splits = self.settings.splits
            num_scenes = writer.manifest.num_scenes
            size_notes = (
                keeps_scenes(num_scenes, self.options.scenes, splits),
                lacks_validation(num_scenes, splits),
            )
            notes += tuple(filter(None, size_notes))
        return Outcome(
            digest=finished.dataset_digest if finished else "",
            num_objects_found=self.accepted.num_found,
            num_objects_used=self.accepted.num_objects,
            num_scenes_given_up=writer.progress.given_up,
            failures=tuple(writer.failures),
            num_shards=len(finished.shards) if finished else writer.num_finished_shards(),
            num_shards_planned=writer.num_shards,
            statistics=statistics,
            notes=notes,
        )

    def require_within_budget(self) -> None:
        """Raise TrilightError if too many scenes failed: in this run, at the end in all runs.

        Scene files that cannot become a scene do not count.
        """
        writer = self.publication
        origin = self.accepted.origin
        num_unusable = len(origin.unusable) if isinstance(origin, SceneFiles) else 0
        num_scenes = writer.manifest.num_scenes
        budget = self.options.failure_budget
        given_up = writer.progress.given_up
        if given_up > budget * num_scenes + num_unusable:
            writer.add_failures(writer.failures)
            raise TrilightError(
                f"{writer.folder.display_name}: {given_up} of {num_scenes} scenes could not be "
                "made, "
                f"more than the failure budget of {budget:.0%}. The reasons are in "
                f"{writer.folder.failures.name}; fix them, or raise --failure-budget."
            )


def children_of_gpu(resolution: int, memory_bytes: int) -> int:
    """Return how many render children keep a GPU busy and fit into its memory.

    Args:
        resolution: of their pictures, in pixels.
        memory_bytes: of the GPU.
    """
    child_bytes = _CHILD_BYTES + _PIXEL_BYTES * resolution**2
    return min(_MOST_CHILDREN, max(1, int(_USED * memory_bytes) // child_bytes))


@dataclass(frozen=True, kw_only=True, eq=False)
class ShardJob:
    """The input that all tasks of a run share; it can be sent to another machine."""

    folder: DatasetFolder
    """The dataset, at the same path on every machine."""
    settings: DatasetSettings
    """Settings of the dataset, with all changes applied."""
    environment: Mapping[str, Any]
    """Environment of the dataset's first run, required of every worker; empty to accept any."""
    accepted: AcceptedObjects
    """The frozen objects; a prepared file that is missing in the user's cache is made again."""
    lock_sha256: str
    """Digest of the frozen objects."""
    num_at_once: int
    """Tasks at a time in one process; they share its cores."""
    extensions: Mapping[str, str]
    """Extensions of the dataset's first run, required of every worker (storage.extensions)."""
    device: Device = "cpu"
    """Device that renders on every worker, `cpu` or `gpu`."""


@dataclass(frozen=True, kw_only=True)
class TaskResult:
    """The result of one task."""

    shards: tuple[ShardEntry, ...]
    """The shards that the task packed."""
    scenes: int
    """Scenes that the task made or gave up, without those that were finished before."""
    seconds: float
    """Wall time of the task."""
    core_s: float
    """Wall time multiplied by the cores of the render child."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """The result of a run."""

    digest: str
    """The dataset digest; empty where the dataset is not finished."""
    num_objects_found: int
    """Objects in the source, or the files that scenes are made of."""
    num_objects_used: int
    """Objects that scenes may draw from."""
    num_scenes_given_up: int
    """Scenes whose every attempt failed; only those of this run while the dataset is unfinished."""
    failures: tuple[Failure, ...]
    """Rejections of this run that are not in `failures.jsonl` yet."""
    num_shards: int
    """Finished shards, as far as this machine knows."""
    num_shards_planned: int
    """Shards of the finished dataset."""
    statistics: Statistics | None
    """Statistics of the dataset; None if it is unfinished, or another machine writes the
    documents."""
    notes: tuple[str, ...] = ()
    """Notes for the user: unknown fields of scene files, unused cameras, and whether a frozen set
    is the published one."""


Watcher = Callable[[Run, TaskResult], None]
"""Called after each task."""


def resolve_settings(
    options: GenerateOptions, folder: DatasetFolder
) -> tuple[DatasetSettings, SceneFolder | None]:
    """Return the dataset's settings, and the scene files if scenes come from files.

    Raises:
        TrilightError: the settings contradict each other, or the source or files are unusable.
    """
    settings = preset_settings(
        options.build,
        seed=options.seed,
        resolution=options.resolution,
        noise_targets=options.noise_targets,
        allow_licences=options.allow_licences,
        changes=options.changes,
    )
    if options.revisits is not None or settings.revisit is not None:
        return settings_for_revisit(settings, options.revisits), None
    source = object_source(settings, options.objects)
    files = options.scenes_from
    listed = None if files is None else find_scene_files(files, options.albedo_over_one)
    if listed is None and not folder.manifest.exists():
        check_source(source, allowed_licences=settings.allowed_licences, licence=options.licence)
    return settings_for_files(settings, listed, options.views), listed


def choose_dataset_variant(options: GenerateOptions, folder: DatasetFolder) -> Variant:
    """Return the variant that renders a dataset.

    It is that of the device which the dataset was begun on, unless the options or TRILIGHT_VARIANT
    name another one. A new dataset takes its preset's device. Raises as `choose_variant`.
    """
    default = DATASET_PRESETS[options.build].device
    device = options.device
    if folder.manifest.exists():
        default = device_of(read_head(folder.manifest).environment)
        device = default if device == "auto" else device
    return choose_variant(default, device=device)
