"""`RevisitedScenes`: reads scenes of a finished dataset and adds new cameras, lights, materials."""

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.exchange.scene_files import SceneFiles
from pipeline.generation.frozen_pool import ComposedScenes
from pipeline.generation.render_sample import KeptPictures, RenderInput
from pipeline.presets.revisit import RevisitSettings
from pipeline.presets.settings import DatasetSettings
from pipeline.scenes.redrawn import with_new_lights, with_new_materials
from pipeline.scenes.scene_checks import require_valid
from pipeline.scenes.views import ViewCamera, cameras_of, with_first_cameras
from pipeline.shards.finished_dataset import (
    FinishedDataset,
    SampleReader,
    open_finished,
    require_whole,
)
from storage.dataset.manifest import ShardEntry
from storage.errors import TrilightError
from storage.records.sample import Sample, decode_sample
from storage.records.scene import Scene
from storage.seeds import SceneKey


@dataclass(frozen=True, kw_only=True)
class RevisitedScenes:
    """Reads the scenes of a finished dataset; a render child has one."""

    root: Path
    """Folder of the finished dataset."""
    digest: str
    """Dataset digest of the finished dataset."""
    _checked: set[str] = field(default_factory=set, compare=False, repr=False)

    def scene(self, index: int, attempt: int, settings: DatasetSettings) -> RenderInput:
        """Return the scene of an index, which counts the scenes of the source shard by shard.

        Args:
            index: index of the scene, from 0.
            attempt: number of earlier rejections of this scene; seeds what is drawn again.
            settings: settings of the new dataset.

        Raises:
            Rejected: the changed scene is invalid, or no camera is found.
            TrilightError: the source is not the one that the dataset was begun with, or damaged.
        """
        revisit = settings.revisit
        assert revisit is not None
        shard, key = self._locate(index, settings)
        with contextlib.closing(SampleReader(self._source)) as reader:
            members = reader.members(shard, key)
        sample = decode_sample(key, members)
        origin = self._origin(sample.scene, key, revisit, settings.seed, attempt)
        scene = _redraw(sample.scene.with_provenance(origin), index, attempt, settings)
        cameras = [*cameras_of(sample.scene)[: revisit.kept_cameras]]
        scene = with_first_cameras(
            scene,
            settings.scenes.of_scene(origin["scene_index"]),
            first_cameras=[*cameras, *_given_cameras(revisit)],
        )
        if not revisit.keeps_light:
            # the triangles stay, except those of the requested lamps: no budget to check
            require_valid(scene, settings.scenes, in_budget=False)
        return RenderInput(
            scene=scene,
            kept_cameras=revisit.kept_cameras + len(revisit.given_cameras),
            kept_pictures=_kept_pictures(sample, members, revisit)
            if self._pictures_stay(settings)
            else None,
        )

    @cached_property
    def _source(self) -> FinishedDataset:
        dataset = open_finished(str(self.root))
        require_digest(dataset, self.digest)
        return dataset

    def _locate(self, index: int, settings: DatasetSettings) -> tuple[ShardEntry, str]:
        """Return the shard and key of a scene; a shard is hashed before its first scene is read."""
        starts = settings.splits.first_scenes
        row = int(np.searchsorted(starts, index, side="right")) - 1
        shard = shards_with_scenes(self._source)[row]
        if shard.name not in self._checked:
            require_whole(self._source, shard)
            self._checked.add(shard.name)
        with contextlib.closing(SampleReader(self._source)) as reader:
            return shard, reader.keys(shard)[index - starts[row]]

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
        now = settings.as_json()
        return (
            settings.revisit is not None
            and settings.revisit.keeps_light
            and (was.get("seed"), was.get("renders")) == (now["seed"], now["renders"])
            and was.get("storage", {}).get("profile") == now["storage"]["profile"]
        )


def shards_with_scenes(source: FinishedDataset) -> list[ShardEntry]:
    """Return the shards of a dataset that hold at least one scene."""
    return [shard for shard in source.manifest.shards if shard.num_samples]


def require_digest(dataset: FinishedDataset, digest: str) -> None:
    """Raise TrilightError if a dataset has another digest."""
    if dataset.manifest.dataset_digest != digest:
        raise TrilightError(
            f"{dataset.folder.root}: its dataset digest is {dataset.manifest.dataset_digest}; "
            f"expected {digest}, whose scenes the new dataset was begun with. Name that one, or "
            "choose another --out."
        )


def _redraw(scene: Scene, index: int, attempt: int, settings: DatasetSettings) -> Scene:
    revisit = settings.revisit
    scene_key = SceneKey(settings.seed, index, attempt)
    assert revisit is not None
    ranges = settings.scenes.of_scene(scene.provenance["scene_index"])
    if revisit.materials == "new":
        scene = with_new_materials(scene, ranges.materials, scene_key)
    if revisit.lights == "new":
        scene = with_new_lights(scene, ranges.lights, revisit.num_lights, scene_key)
    return scene


def _given_cameras(revisit: RevisitSettings) -> list[ViewCamera]:
    return [
        ViewCamera(
            c2w=np.array(camera.c2w, np.float32).reshape(4, 4),
            fov_deg=np.float32(camera.fov_deg),
            attempt=0,
        )
        for camera in revisit.given_cameras
    ]


def _kept_pictures(
    sample: Sample, members: Mapping[str, bytes], revisit: RevisitSettings
) -> KeptPictures | None:
    count = min(revisit.kept_cameras, len(sample.views))
    names = {f"{view}.{kind}exr" for view in range(count) for kind in ("", "lights.", "parts.")}
    of_views = {suffix: data for suffix, data in members.items() if suffix in names}
    return KeptPictures(num_views=count, sample=sample, members=of_views) if count else None


SceneOrigin = ComposedScenes | SceneFiles | RevisitedScenes
"""Layouts, scene files (then the objects are the files), or the scenes of a finished dataset."""
