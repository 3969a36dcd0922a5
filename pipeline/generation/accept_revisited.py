"""Takes scenes, objects and splits of a new dataset from a finished one."""

import dataclasses

from pipeline.generation.dataset_writer import DatasetWriter
from pipeline.generation.freeze_objects import AcceptedObjects, read_frozen_objects
from pipeline.generation.revisited_scenes import RevisitedScenes, require_digest, shards_with_scenes
from pipeline.presets.revisit import RevisitSettings
from pipeline.presets.settings import DatasetSettings
from pipeline.shards.finished_dataset import open_finished
from storage.dataset.settings import ListedShard
from storage.digests import canonical_json
from storage.errors import TrilightError
from storage.records.objects import OBJECT


def settings_for_revisit(settings: DatasetSettings, path: str | None) -> DatasetSettings:
    """Return the settings of a dataset that has the views and shards of a finished one.

    Without a path, the settings stay as they are.

    Raises:
        TrilightError: only one of path and `settings.revisit` is given, the dataset at the path is
            unfinished or another one, or its scenes have fewer cameras than `kept_cameras`.
    """
    revisit = settings.revisit
    if path is None and revisit is None:
        return settings
    if path is None or revisit is None:
        raise TrilightError(
            f"revisits is {path!r} and the settings of a revisit are "
            f"{'missing' if revisit is None else 'there'}; expected both. Use `trilight revisit`."
        )
    source = open_finished(path)
    require_digest(source, revisit.source_digest)
    if revisit.kept_cameras > source.manifest.num_views:
        raise TrilightError(
            f"kept_cameras is {revisit.kept_cameras}; expected at most "
            f"{source.manifest.num_views}, the views of each scene of {path}."
        )
    _require_layouts(settings, revisit, path)
    scenes = dataclasses.replace(settings.scenes, num_views=revisit.num_views)
    listed = tuple(
        ListedShard(split=shard.split, scenes=shard.num_samples)
        for shard in shards_with_scenes(source)
    )
    splits = dataclasses.replace(settings.splits, listed_shards=listed)
    return dataclasses.replace(settings, scenes=scenes, splits=splits)


def _require_layouts(settings: DatasetSettings, revisit: RevisitSettings, path: str) -> None:
    """Raise if scenes of files should get cameras or lights that only a layout can draw."""
    if settings.splits.listed_scenes is None:
        return
    if revisit.new_cameras and revisit.camera_layout is None:
        raise TrilightError(
            f"{path}: its scenes are of files, whose own layout draws no cameras; expected a "
            "layout and a number, such as --cameras plane:4, or a file with cameras."
        )
    if revisit.lights == "new":
        raise TrilightError(
            f"{path}: its scenes are of files, whose own layout draws no lights; expected "
            "--lights keep."
        )


def accept_revisited(
    path: str, settings: DatasetSettings, writer: DatasetWriter
) -> AcceptedObjects:
    """Freeze the objects of a finished dataset for the new one, with their licences and splits.

    Raises:
        TrilightError: it is not the dataset that the new one was begun with.
    """
    source = open_finished(path)
    assert settings.revisit is not None
    require_digest(source, settings.revisit.source_digest)
    locked = sorted(
        (entry for entries in source.objects.values() for entry in entries),
        key=lambda entry: canonical_json(dataclasses.asdict(entry)),
    )
    if read_frozen_objects(writer) is None:
        writer.add_failures(())
        writer.lock_objects(locked)
    root = source.folder.root.resolve()
    return AcceptedObjects(
        num_objects=sum(entry.kind == OBJECT for entry in locked),
        num_found=len(locked),
        origin=RevisitedScenes(root=root, digest=source.manifest.dataset_digest),
    )
