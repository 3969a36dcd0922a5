"""Checks a folder of scene files and freezes the list of files that the dataset is made of."""

import contextlib
import dataclasses
from collections.abc import Mapping
from pathlib import Path

from pipeline.assets.settings import AssetSettings
from pipeline.exchange.from_description import AlbedoOverOne, scaled_albedo_notes
from pipeline.exchange.scene_files import SceneFiles, SceneFolder, build_scene, require_usable
from pipeline.generation.dataset_writer import DatasetWriter
from pipeline.generation.freeze_objects import require_same
from pipeline.generation.prepare_isolated import asset_child
from pipeline.generation.revisited_scenes import AcceptedObjects
from pipeline.isolation import ChildFailed, IsolatedChild, call_with_retries, reach
from pipeline.objects.licences import stated_licence
from pipeline.presets.settings import DatasetSettings
from storage.dataset.layout import DatasetFolder
from storage.dataset.progress import announce_objects, count_object
from storage.dataset.splits import JUDGED_SPLIT
from storage.errors import EnvironmentFailure, TrilightError
from storage.records.objects import LockedObject


def settings_for_files(
    settings: DatasetSettings, folder: SceneFolder, views: int | None
) -> DatasetSettings:
    """Return the preset's settings with the number of scenes and views of a folder.

    Raises:
        TrilightError: a file has fewer cameras than `views`.
    """
    return dataclasses.replace(
        settings,
        scenes=dataclasses.replace(settings.scenes, num_views=folder.views(views)),
        splits=dataclasses.replace(
            settings.splits, one_split=True, listed_scenes=len(folder.names)
        ),
    )


def accept_scene_files(
    folder: SceneFolder,
    licence: str | None,
    settings: DatasetSettings,
    writer: DatasetWriter,
) -> AcceptedObjects:
    """Build every scene once, without rendering; the first run freezes their files.

    A file that cannot become a scene is noted, and the files that it names are not frozen for it.

    Raises:
        TrilightError: no scene at all can be built, the licence is not allowed, or the files are
            not those that the dataset was begun with.
    """
    stated = stated_licence(licence)
    if stated.licence.casefold() not in {name.casefold() for name in settings.allowed_licences}:
        raise TrilightError(
            f"--licence is {stated.licence}, which is not on the allow-list; if you may use the "
            f"scenes, add --allow-licence '{stated.licence}'."
        )
    with writer.hold_lock("objects"):
        files = _build_all(folder, stated.licence, settings, writer.folder)
        locked = [
            LockedObject(
                uid=uid,
                asset_sha256=digest,
                split=JUDGED_SPLIT,
                licence=stated.licence,
                licence_source=stated.licence_source,
                title=uid,
                attribution="",
                source_url="",
            )
            for uid, digest in sorted(files.sha256.items())
        ]
        frozen = writer.frozen_objects()
        if frozen is None:
            writer.lock_objects(locked)
        else:
            require_same("scene files", frozen, locked)
    return AcceptedObjects(num_objects=len(locked), num_found=len(locked), origin=files)


def _build_all(
    folder: SceneFolder, licence: str, settings: DatasetSettings, out: DatasetFolder
) -> SceneFiles:
    """Build every scene; return digests of the usable files, and errors of the others."""
    announce_objects(out, len(folder.names))
    num_views = settings.scenes.num_views
    sha256: dict[str, str] = {}
    notes: list[str] = []
    unusable = dict(folder.unusable)
    with contextlib.closing(asset_child(reach(files=[folder.root]))) as child:
        for name in folder.names:
            if name not in unusable:
                try:
                    digests, words = _build_in_child(child, folder, name, settings)
                    sha256 |= digests
                    notes += words
                except EnvironmentFailure:
                    raise
                except TrilightError as mistake:
                    unusable[name] = str(mistake)
            count_object(out)
    require_usable(folder.names, unusable)
    left_out = (f"{name} is left out: {why.rstrip('.')}" for name, why in unusable.items())
    return SceneFiles(
        root=folder.root,
        names=folder.names,
        sha256=sha256,
        unusable=unusable,
        licence=licence,
        albedo_over_one=folder.albedo_over_one,
        notes=(*notes, *left_out, *folder.notes(num_views)),
    )


def build_once(
    root: Path, name: str, settings: AssetSettings, num_views: int, over_one: AlbedoOverOne
) -> tuple[Mapping[str, str], tuple[str, ...]]:
    """Build a scene once as a check; return the digests of its files, and notes for the user.

    Files are named by their path below the folder. Runs only in child processes; raises as
    `build_scene`.
    """
    unread: list[str] = []
    scene, sha256 = build_scene(
        root,
        name,
        settings,
        licence="",
        num_views=num_views,
        scene_index=0,
        seed=0,
        albedo_over_one=over_one,
        notes=unread,
    )
    return sha256, tuple(f"{name}: {text}" for text in (*unread, *scaled_albedo_notes(scene)))


def _build_in_child(
    child: IsolatedChild, folder: SceneFolder, name: str, settings: DatasetSettings
) -> tuple[Mapping[str, str], tuple[str, ...]]:
    """Build a scene in a child; raises TrilightError, or EnvironmentFailure for the machine."""
    arguments = (settings.assets, settings.scenes.num_views, folder.albedo_over_one)
    try:
        return call_with_retries(child, build_once, folder.root, name, *arguments)
    except ChildFailed as failure:
        if failure.is_verdict:
            raise TrilightError(
                f"{name}: its meshes cannot be read ({failure}); fix or remove the file."
            ) from failure
        raise EnvironmentFailure(
            f"{name}: its meshes could not be read this time ({failure}). Run the same command "
            "again; if that does not help, see `trilight doctor`."
        ) from failure
