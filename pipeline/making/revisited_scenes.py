"""Scenes of a finished dataset, with what is new in them: what render children make samples of."""

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.builds.revisit import RevisitSettings
from pipeline.builds.settings import BuildSettings
from pipeline.making.render_sample import BegunScene, KeptPictures
from pipeline.scenes.laws import require_laws
from pipeline.scenes.redrawn import with_new_lights, with_new_materials
from pipeline.scenes.views import ViewCamera, cameras_of, with_first_cameras
from pipeline.shards.finished import FinishedDataset, SampleReader, open_finished, require_whole
from storage.dataset.manifest import ShardEntry
from storage.errors import TrilightError
from storage.records.sample import Sample, decode_sample
from storage.records.scene import Scene


@dataclass(frozen=True, kw_only=True)
class RevisitedScenes:
    """Reads the scenes of a finished dataset; a render child has one."""

    root: Path
    """Its folder."""
    digest: str
    """Its dataset digest."""
    _checked: set[str] = field(default_factory=set, compare=False, repr=False)

    def scene(self, index: int, attempt: int, settings: BuildSettings) -> BegunScene:
        """Return the scene of an index: the position in the source, shard by shard.

        Args:
            index: from 0.
            attempt: how many times this scene was rejected before; decides what is drawn anew.
            settings: of the new dataset.

        Raises:
            Rejected: what is drawn anew breaks a law, or no camera is found.
            TrilightError: the source is not the one that the dataset was begun with, or damaged.
        """
        asked = settings.revisit
        assert asked is not None
        shard, key = self._place(index, settings)
        with contextlib.closing(SampleReader(self._source)) as reader:
            members = reader.members(shard, key)
        sample = decode_sample(key, members)
        origin = self._origin(sample.scene, key, asked, settings.seed, attempt)
        scene = _redrawn(sample.scene.with_provenance(origin), index, attempt, settings)
        cameras = [*cameras_of(sample.scene)[: asked.kept_cameras]]
        scene = with_first_cameras(
            scene,
            settings.scenes.of_scene(origin["scene_index"]),
            given=[*cameras, *_given(asked)],
        )
        if not asked.keeps_light:
            # its triangles are those of before, but for the lamps that were asked for
            require_laws(scene, settings.scenes, in_budget=False)
        return BegunScene(
            scene=scene,
            kept_cameras=asked.kept_cameras + len(asked.given_cameras),
            kept=_kept(sample, members, asked) if self._pictures_stay(settings) else None,
        )

    @cached_property
    def _source(self) -> FinishedDataset:
        found = open_finished(str(self.root))
        require_digest(found, self.digest)
        return found

    def _place(self, index: int, settings: BuildSettings) -> tuple[ShardEntry, str]:
        """Return where a scene lies; its shard is hashed before its first scene is read."""
        starts = settings.splits.first_scenes
        row = int(np.searchsorted(starts, index, side="right")) - 1
        shard = shards_with_scenes(self._source)[row]
        if shard.name not in self._checked:
            require_whole(self._source, shard)
            self._checked.add(shard.name)
        with contextlib.closing(SampleReader(self._source)) as reader:
            return shard, reader.keys(shard)[index - starts[row]]

    def _origin(
        self, scene: Scene, key: str, asked: RevisitSettings, seed: int, attempt: int
    ) -> dict[str, Any]:
        before = dict(scene.provenance)
        step = {"dataset_digest": self.digest, "key": key, "seed": seed, "attempt": attempt}
        origin = {**before, "revisited": [*before.get("revisited", []), step]}
        if asked.new_cameras and not (asked.kept_cameras and asked.camera_layout is None):
            layout = asked.camera_layout or before["template"]
            origin["new_cameras"] = {"layout": layout, "seed": seed}
        return origin

    def _pictures_stay(self, settings: BuildSettings) -> bool:
        """Return whether a picture of the same scene and camera would be made and packed alike."""
        was, now = self._source.manifest.settings, settings.as_json()
        return (
            settings.revisit is not None
            and settings.revisit.keeps_light
            and (was.get("seed"), was.get("renders")) == (now["seed"], now["renders"])
            and was.get("storage", {}).get("profile") == now["storage"]["profile"]
        )


def shards_with_scenes(source: FinishedDataset) -> list[ShardEntry]:
    """Return the shards of a dataset, without those of which every scene was given up."""
    return [shard for shard in source.manifest.shards if shard.num_samples]


def require_digest(found: FinishedDataset, digest: str) -> None:
    """Raise TrilightError where a dataset is not the one that has this digest."""
    if found.manifest.dataset_digest != digest:
        raise TrilightError(
            f"{found.folder.root}: its dataset digest is {found.manifest.dataset_digest}; expected "
            f"{digest}, whose scenes the new dataset was begun with. Name that one, or choose "
            "another --out."
        )


def _redrawn(scene: Scene, index: int, attempt: int, settings: BuildSettings) -> Scene:
    asked, seed = settings.revisit, settings.seed
    assert asked is not None
    ranges = settings.scenes.of_scene(scene.provenance["scene_index"])
    if asked.materials == "new":
        scene = with_new_materials(scene, ranges.materials, seed=seed, index=index, attempt=attempt)
    if asked.lights == "new":
        scene = with_new_lights(
            scene, ranges.lights, asked.num_lights, seed=seed, index=index, attempt=attempt
        )
    return scene


def _given(asked: RevisitSettings) -> list[ViewCamera]:
    return [
        ViewCamera(
            c2w=np.array(camera.c2w, np.float32).reshape(4, 4),
            fov_deg=np.float32(camera.fov_deg),
            attempt=0,
        )
        for camera in asked.given_cameras
    ]


def _kept(
    sample: Sample, members: Mapping[str, bytes], asked: RevisitSettings
) -> KeptPictures | None:
    count = min(asked.kept_cameras, len(sample.views))
    names = {f"{view}.{kind}exr" for view in range(count) for kind in ("", "lights.", "parts.")}
    of_views = {suffix: data for suffix, data in members.items() if suffix in names}
    return KeptPictures(num_views=count, sample=sample, members=of_views) if count else None
