"""From a finished dataset to one that has its scenes, its objects and its splits."""

import dataclasses

from pipeline.builds.revisit import RevisitSettings
from pipeline.builds.settings import BuildSettings
from pipeline.making.freeze_objects import AcceptedObjects, frozen_objects
from pipeline.making.publication import Publication
from pipeline.making.revisited_scenes import RevisitedScenes, require_digest, shards_with_scenes
from pipeline.shards.finished import open_finished
from storage.dataset.settings import ListedShard
from storage.digests import canonical_json
from storage.errors import TrilightError
from storage.records.objects import OBJECT


def settings_for_revisit(settings: BuildSettings, place: str | None) -> BuildSettings:
    """Return the settings of a dataset with the scenes of another: its views, and its shards.

    Without a place, the settings stay as they are.

    Raises:
        TrilightError: only one of place and `settings.revisit` is given, the dataset there is
            unfinished or another one, or its scenes have fewer cameras than are to be kept.
    """
    asked = settings.revisit
    if place is None and asked is None:
        return settings
    if place is None or asked is None:
        raise TrilightError(
            f"revisits is {place!r} and the settings of a revisit are "
            f"{'missing' if asked is None else 'there'}; expected both. Use `trilight revisit`."
        )
    source = open_finished(place)
    require_digest(source, asked.source_digest)
    if asked.kept_cameras > source.manifest.num_views:
        raise TrilightError(
            f"kept_cameras is {asked.kept_cameras}; expected at most "
            f"{source.manifest.num_views}, the views of each scene of {place}."
        )
    _require_layouts(settings, asked, place)
    scenes = dataclasses.replace(settings.scenes, num_views=asked.num_views)
    listed = tuple(
        ListedShard(split=shard.split, scenes=shard.num_samples)
        for shard in shards_with_scenes(source)
    )
    splits = dataclasses.replace(settings.splits, listed_shards=listed)
    return dataclasses.replace(settings, scenes=scenes, splits=splits)


def _require_layouts(settings: BuildSettings, asked: RevisitSettings, place: str) -> None:
    """Refuse to draw, in scenes of files, what only a layout of ours can say."""
    if settings.splits.listed_scenes is None:
        return
    if asked.new_cameras and asked.camera_layout is None:
        raise TrilightError(
            f"{place}: its scenes are of files, whose own layout draws no cameras; expected a "
            "layout and a number, such as --cameras plane:4, or a file with cameras."
        )
    if asked.lights == "new":
        raise TrilightError(
            f"{place}: its scenes are of files, whose own layout draws no lights; expected "
            "--lights keep."
        )


def accept_revisited(
    place: str, settings: BuildSettings, publication: Publication
) -> AcceptedObjects:
    """Take over the frozen objects of a finished dataset, with their licences and splits.

    Raises:
        TrilightError: it is another dataset than the one that was begun with.
    """
    source = open_finished(place)
    assert settings.revisit is not None
    require_digest(source, settings.revisit.source_digest)
    locked = sorted(
        (entry for entries in source.objects.values() for entry in entries),
        key=lambda entry: canonical_json(dataclasses.asdict(entry)),
    )
    if frozen_objects(publication) is None:
        publication.add_failures(())
        publication.lock_objects(locked)
    root = source.folder.root.resolve()
    return AcceptedObjects(
        num_objects=sum(entry.kind == OBJECT for entry in locked),
        num_found=len(locked),
        revisited=RevisitedScenes(root=root, digest=source.manifest.dataset_digest),
    )
