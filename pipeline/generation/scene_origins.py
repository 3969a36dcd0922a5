"""Where scenes come from: layouts of frozen objects, scene files, or a finished dataset.

Scene files are checked and frozen by their digests. A revisit takes scenes, objects and splits of a
new dataset from a finished one, and adds new cameras, lights and materials. Frozen objects are
opened when a scene draws them (pipeline.generation.scene_worker).
"""

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.assets.settings import AssetSettings
from pipeline.exchange.from_description import AlbedoOverOne
from pipeline.exchange.scene_files import SceneFiles, build_scene, require_usable
from pipeline.generation.dataset_writer import DatasetWriter
from pipeline.generation.prepare_isolated import asset_child
from pipeline.isolation import ChildFailed, call_with_retries, reach
from pipeline.objects.licences import stated_licence
from pipeline.presets.settings import DatasetSettings, RevisitSettings
from pipeline.scenes.redrawn import with_new_lights, with_new_materials
from pipeline.scenes.views import ViewCamera, cameras_of, require_valid, with_first_cameras
from pipeline.shards.finished_dataset import open_finished
from storage.dataset.dataset import Dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import ShardEntry
from storage.dataset.progress import announce_objects, count_object
from storage.dataset.settings import ListedShard
from storage.dataset.splits import JUDGED_SPLIT
from storage.digests import canonical_json
from storage.errors import EnvironmentFailure, TrilightError
from storage.records.objects import OBJECT, LockedObject
from storage.records.sample import Sample, decode_sample
from storage.records.scene import Scene
from storage.seeds import SceneKey
from storage.settings.described import settings_record


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderInput:
    """A scene to render, with the cameras and pictures that stay."""

    scene: Scene
    """The scene, with a camera for each view."""
    kept_cameras: int = 0
    """Number of first cameras that are never replaced: their rejection rejects the scene."""
    kept_views: int = 0
    """Number of first cameras whose pictures need not be rendered again."""
    kept_sample: Sample | None = None
    """The sample that holds the kept pictures."""
    kept_members: Mapping[str, bytes] = field(default_factory=dict)
    """Packed files of the kept pictures, by suffix."""


@dataclass(frozen=True, kw_only=True)
class ComposedScenes:
    """Scenes that layouts compose of frozen objects; can be sent to another machine."""

    lock: Path
    """Path of objects.lock.jsonl in the dataset's folder."""
    index: Path
    """Path of the lock's index (storage.records.object_index)."""
    source: str
    """Source of the objects, for those that have to be prepared again."""
    licence: str | None
    """Licence that the user states for files without one."""
    maps: tuple[tuple[LockedObject, Path], ...] = ()
    """The user's textures and skies with their prepared files."""


@dataclass(frozen=True, kw_only=True)
class RevisitedScenes:
    """Reads the scenes of a finished dataset; a render child has one."""

    root: Path
    """Folder of the finished dataset."""
    digest: str

    def scene(self, index: int, attempt: int, settings: DatasetSettings) -> RenderInput:
        """Return the scene of an index, which counts the scenes of the source shard by shard.

        Args:
            attempt: number of earlier rejections of this scene; seeds what is drawn again.

        Raises:
            Rejected: the changed scene is invalid, or no camera is found.
            TrilightError: the source is not the one that the dataset was begun with, or damaged.
        """
        revisit = settings.revisit
        assert revisit is not None
        starts = settings.splits.first_scenes
        row = int(np.searchsorted(starts, index, side="right")) - 1
        shard = shards_with_scenes(self._source)[row]
        with self._source.open_shard(shard, checked=True) as opened:
            key = list(opened.samples)[index - starts[row]]
            members = opened.members(key)
        sample = decode_sample(key, members)
        origin = self._origin(sample.scene, key, revisit, settings.seed, attempt)
        scene = sample.scene.with_provenance(origin)
        ranges = settings.scenes.of_scene(origin["scene_index"])
        scene_key = SceneKey(settings.seed, index, attempt)
        if revisit.materials == "new":
            scene = with_new_materials(scene, ranges.materials, scene_key)
        if revisit.lights == "new":
            scene = with_new_lights(scene, ranges.lights, revisit.num_lights, scene_key)
        given_cameras = [
            ViewCamera(
                c2w=np.array(camera.c2w, np.float32).reshape(4, 4),
                fov_deg=np.float32(camera.fov_deg),
                attempt=0,
            )
            for camera in revisit.given_cameras
        ]
        scene = with_first_cameras(
            scene,
            ranges,
            first_cameras=[*cameras_of(sample.scene)[: revisit.kept_cameras], *given_cameras],
        )
        if not revisit.keeps_light:
            # the triangles stay, except those of the requested lamps: no budget to check
            require_valid(scene, settings.scenes, in_budget=False)
        stay = self._pictures_stay(settings)
        count = min(revisit.kept_cameras, len(sample.views)) if stay else 0
        kinds = ("", "lights.", "parts.")
        suffixes = {f"{view}.{kind}exr" for view in range(count) for kind in kinds}
        return RenderInput(
            scene=scene,
            kept_cameras=revisit.kept_cameras + len(given_cameras),
            kept_views=count,
            kept_sample=sample,
            kept_members={suffix: data for suffix, data in members.items() if suffix in suffixes},
        )

    @cached_property
    def _source(self) -> Dataset:
        return open_source(str(self.root), self.digest)

    def _origin(
        self, scene: Scene, key: str, revisit: RevisitSettings, seed: int, attempt: int
    ) -> dict[str, Any]:
        before = dict(scene.provenance)
        step = {"dataset_digest": self.digest, "key": key, "seed": seed, "attempt": attempt}
        origin = {**before, "revisited": [*before.get("revisited", []), step]}
        if revisit.new_cameras and not (revisit.kept_cameras and revisit.camera_layout is None):
            layout = revisit.camera_layout or before.get("template", "unknown")
            origin["new_cameras"] = {"layout": layout, "seed": seed}
        return origin

    def _pictures_stay(self, settings: DatasetSettings) -> bool:
        """Return True if an equal scene and camera would give equal picture files."""
        was = self._source.manifest.settings
        now = settings_record(settings)
        return (
            settings.revisit is not None
            and settings.revisit.keeps_light
            and (was.get("seed"), was.get("renders")) == (now["seed"], now["renders"])
            and was.get("storage", {}).get("profile") == now["storage"]["profile"]
        )


def shards_with_scenes(source: Dataset) -> list[ShardEntry]:
    """Return the shards of a dataset that hold at least one scene."""
    return [shard for shard in source.manifest.shards if shard.num_samples]


def open_source(path: str, digest: str) -> Dataset:
    """Open a finished dataset; raises TrilightError if it has another digest, or as that does."""
    dataset = open_finished(path)
    if dataset.manifest.dataset_digest != digest:
        raise TrilightError(
            f"{dataset.folder.root}: its dataset digest is {dataset.manifest.dataset_digest}; "
            f"expected {digest}, whose scenes the new dataset was begun with. Name that one, or "
            "choose another --out."
        )
    return dataset


SceneOrigin = ComposedScenes | SceneFiles | RevisitedScenes
"""Layouts, scene files (then the objects are the files), or the scenes of a finished dataset."""


@dataclass(frozen=True, kw_only=True)
class AcceptedObjects:
    """The frozen inputs of a dataset's scenes."""

    num_objects: int
    """Objects that scenes may draw from."""
    num_found: int
    """Objects in the source, refused ones included."""
    origin: SceneOrigin


Accept = Callable[[DatasetWriter], AcceptedObjects]
"""Freezes the inputs of a dataset's scenes, or requires that they are those that were frozen."""


def resolve_revisit(settings: DatasetSettings, path: str | None) -> tuple[DatasetSettings, Accept]:
    """Return the settings of a dataset that has the views and shards of a finished one.

    Raises:
        TrilightError: only one of path and `settings.revisit` is given, the dataset at the path is
            unfinished or another one, or its scenes have fewer cameras than `kept_cameras`.
    """
    revisit = settings.revisit
    if path is None or revisit is None:
        raise TrilightError(
            f"revisits is {path!r} and the settings of a revisit are "
            f"{'missing' if revisit is None else 'there'}; expected both. Use `trilight revisit`."
        )
    source = open_source(path, revisit.source_digest)
    if revisit.kept_cameras > source.manifest.num_views:
        raise TrilightError(
            f"kept_cameras is {revisit.kept_cameras}; expected at most "
            f"{source.manifest.num_views}, the views of each scene of {path}."
        )
    if settings.splits.listed_scenes is not None:
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
    scenes = dataclasses.replace(settings.scenes, num_views=revisit.num_views)
    listed = tuple(
        ListedShard(split=shard.split, scenes=shard.num_samples)
        for shard in shards_with_scenes(source)
    )
    splits = dataclasses.replace(settings.splits, listed_shards=listed)
    settings = dataclasses.replace(settings, scenes=scenes, splits=splits)
    return settings, partial(_accept_objects, source)


def _accept_objects(source: Dataset, writer: DatasetWriter) -> AcceptedObjects:
    """Freeze the objects of a finished dataset for the new one, with their licences and splits."""
    locked = sorted(
        source.objects_lock(), key=lambda entry: canonical_json(dataclasses.asdict(entry))
    )
    with writer.hold_lock("objects"):
        if writer.frozen_objects() is None:
            writer.add_failures(())
            writer.lock_objects(locked)
    root = source.folder.root.resolve()
    return AcceptedObjects(
        num_objects=sum(entry.kind == OBJECT for entry in locked),
        num_found=len(locked),
        origin=RevisitedScenes(root=root, digest=source.manifest.dataset_digest),
    )


def changed_error(display_name: str, uid: str, state: str) -> TrilightError:
    """Return the error of a frozen object or file that its source has lost or changed."""
    return TrilightError(
        f"{display_name}: {uid!r} {state}; expected what the dataset was begun with "
        "(objects.lock.jsonl). Restore it, name the source that has it by --objects or "
        "--scenes-from, or choose another --out."
    )


def require_same(
    display_name: str, frozen: Mapping[str, LockedObject], now: Sequence[LockedObject]
) -> None:
    """Raise TrilightError if a row differs from the frozen one, is missing, or is new."""
    by_uid = {entry.uid: entry for entry in now}
    for uid in sorted({*frozen, *by_uid}):
        if frozen.get(uid) != by_uid.get(uid):
            state = "has changed" if uid in by_uid else "is missing or no longer usable"
            raise changed_error(display_name, uid, state if uid in frozen else "is new")


def settings_for_files(
    settings: DatasetSettings, folder: SceneFiles, views: int | None
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
    folder: SceneFiles,
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
    name = stated["licence"]
    if name.casefold() not in {name.casefold() for name in settings.allowed_licences}:
        raise TrilightError(
            f"--licence is {name}, which is not on the allow-list; if you may use the "
            f"scenes, add --allow-licence '{name}'."
        )
    with writer.hold_lock("objects"):
        files = _build_all(folder, name, settings, writer.folder)
        locked = [
            LockedObject(
                uid=uid,
                asset_sha256=digest,
                split=JUDGED_SPLIT,
                title=uid,
                attribution="",
                source_url="",
                **stated,
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
    folder: SceneFiles, licence: str, settings: DatasetSettings, out: DatasetFolder
) -> SceneFiles:
    """Build every scene; return digests of the usable files, and errors of the others.

    Raises:
        EnvironmentFailure: a file could not be read this time.
        TrilightError: no file is usable.
    """
    announce_objects(out, len(folder.names))
    num_views = settings.scenes.num_views
    over_one = folder.albedo_over_one
    sha256: dict[str, str] = {}
    notes: list[str] = []
    unusable = dict(folder.unusable)
    with contextlib.closing(asset_child(reach([folder.root]))) as child:
        for name in folder.names:
            if name not in unusable:
                try:
                    digests, words = call_with_retries(
                        child, build_once, folder.root, name, settings.assets, num_views, over_one
                    )
                    sha256 |= digests
                    notes += words
                except ChildFailed as failure:
                    if not failure.is_verdict:
                        raise EnvironmentFailure(
                            f"{name}: its meshes could not be read this time ({failure}). Run the "
                            "same command again; if that does not help, see `trilight doctor`."
                        ) from failure
                    why = f"its meshes cannot be read ({failure}); fix or remove the file."
                    unusable[name] = f"{name}: {why}"
                except EnvironmentFailure:
                    raise
                except TrilightError as mistake:
                    unusable[name] = str(mistake)
            count_object(out)
    require_usable(folder.names, unusable)
    left_out = (f"{name} is left out: {why.rstrip('.')}" for name, why in unusable.items())
    notes += (*left_out, *folder.notes, *folder.unused_camera_notes(num_views))
    return dataclasses.replace(
        folder,
        sha256=sha256,
        unusable=unusable,
        licence=licence,
        notes=tuple(dict.fromkeys(notes)),  # the folder's unknown fields are those of its scenes
    )


def build_once(
    root: Path, name: str, settings: AssetSettings, num_views: int, over_one: AlbedoOverOne
) -> tuple[Mapping[str, str], tuple[str, ...]]:
    """Build a scene once as a check; return the digests of its files, and notes for the user.

    Files are named by their path below the folder. Runs only in child processes; raises as
    `build_scene`.
    """
    loaded, sha256 = build_scene(
        root, name, settings, licence="", num_views=num_views, albedo_over_one=over_one
    )
    return sha256, tuple(f"{name}: {text}" for text in loaded.notes)
