"""`DatasetSettings`: all settings that decide the contents of a dataset, except its size."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import pydantic

from pipeline.assets.settings import AssetSettings
from pipeline.renders.mitsuba_variant import Device
from pipeline.renders.settings import RenderSettings
from scene_templates.settings import SceneSettings
from scene_templates.templates import TEMPLATES
from storage.dataset.settings import SplitSettings, StorageSettings
from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError
from storage.settings.described import checked, settings_record
from storage.settings.ranges import FLOAT32_MAX, Seed, Within

MOST_CAMERAS = 1000
"""Cameras of a scene; given ones stand in the manifest."""

_POSE = 16


@checked("revisit settings")
class GivenCamera:
    """A camera of every scene."""

    c2w: Annotated[tuple[float, ...], Within(-FLOAT32_MAX, FLOAT32_MAX)]
    """Camera to world, 4 x 4, row by row."""
    fov_deg: Annotated[float, Within(0, 180, low_open=True, high_open=True, unit="degrees")]
    """Full field of view of the camera."""

    def __post_init__(self) -> None:
        if len(self.c2w) != _POSE:
            raise TrilightError(f"c2w is {len(self.c2w)} numbers; expected {_POSE}.")


@checked("revisit settings")
class RevisitSettings:
    """Changes to the scenes of a finished dataset."""

    source_digest: str
    """Dataset digest of the finished dataset."""
    kept_cameras: Annotated[int, Within(0, MOST_CAMERAS, unit="cameras")]
    """Number of cameras that each scene keeps, from its first."""
    new_cameras: Annotated[int, Within(0, MOST_CAMERAS, unit="cameras")] = 0
    """Number of cameras that are drawn for each scene after those: where it keeps some and no
    layout is named, the ones that a dataset with more views would have had; else new ones, by the
    dataset's seed."""
    camera_layout: str | None = None
    """Layout that draws the new cameras; by default each scene's own."""
    given_cameras: tuple[GivenCamera, ...] = ()
    """Cameras that each scene gets after those; by default there are none."""
    lights: Literal["keep", "new"] = "keep"
    """Choice to keep the lights, or to draw new ones by `scenes.lights` and each scene's layout."""
    num_lights: Annotated[int | None, Within(1, 64, unit="emitters")] = None
    """Number of the new lights of each scene; by default as many as it has."""
    materials: Literal["keep", "new"] = "keep"
    """Choice to keep the materials, or to draw new ones by `scenes.materials`; faces that share a
    color still do."""

    def __post_init__(self) -> None:
        if not 1 <= self.num_views <= MOST_CAMERAS:
            raise TrilightError(
                f"cameras: {self.num_views} for each scene; expected 1 to {MOST_CAMERAS}."
            )
        if self.camera_layout is not None:
            TEMPLATES.find(self.camera_layout)
        if self.num_lights is not None and self.lights == "keep":
            raise TrilightError("num_lights: expected it only where lights are new.")

    @property
    def num_views(self) -> int:
        """Number of views of each scene."""
        return self.kept_cameras + self.new_cameras + len(self.given_cameras)

    @property
    def keeps_light(self) -> bool:
        """True if only cameras change, so that a kept camera sees the same picture."""
        return self.lights == "keep" and self.materials == "keep"


@checked()
class DatasetSettings:
    """The settings of one dataset. They are stored in its manifest and never change."""

    build: str
    """Name of the preset that the settings come from."""
    seed: Seed
    """Seed of objects, scenes, cameras and samples."""
    source: str | None = None
    """Source that the objects must come from; by default the user chooses one."""
    allowed_licences: tuple[str, ...]
    """Licences of objects that may be used."""
    assets: AssetSettings
    """Settings of the mesh stage, which converts objects to meshes."""
    scenes: SceneSettings
    """Settings of composition, which places meshes, lights and cameras in scenes."""
    renders: RenderSettings
    """Settings of rendering, which makes a picture of each view."""
    splits: SplitSettings
    """Settings that divide objects and scenes into splits and shards."""
    storage: StorageSettings = dataclasses.field(default_factory=StorageSettings)
    """Settings of the files in which arrays and pictures are packed."""
    revisit: RevisitSettings | None = None
    """Changes to the scenes of a finished dataset; by default scenes are composed."""

    @pydantic.model_serializer(mode="wrap")
    def _record(self, as_usual: pydantic.SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Omit `revisit` if there is none, so that digests of earlier presets stay.

        The settings of the mesh stage are recorded with the changes that scenes require.
        """
        record: dict[str, Any] = as_usual(self)
        if self.mesh_settings.own_materials.keep:
            record["assets"] = settings_record(self.mesh_settings)
        return {name: value for name, value in record.items() if name != "revisit" or value}

    def __post_init__(self) -> None:
        if not self.allowed_licences:
            raise TrilightError("allowed_licences is empty; expected at least one licence.")

    @property
    def mesh_settings(self) -> AssetSettings:
        """Settings of the mesh stage: objects keep their materials if scenes require them."""
        source_materials = self.assets.own_materials
        keeps_materials = self.scenes.materials.source == "object"
        emission = source_materials.emission or (
            keeps_materials and self.scenes.materials.own_emission > 0
        )
        source_materials = dataclasses.replace(
            source_materials, keep=source_materials.keep or keeps_materials, emission=emission
        )
        return dataclasses.replace(self.assets, own_materials=source_materials)

    @property
    def digest(self) -> str:
        """sha256 of the settings."""
        return sha256_hex(canonical_json(settings_record(self)))


@dataclass(frozen=True, kw_only=True)
class DatasetPreset:
    """A dataset preset that the command line knows by name."""

    settings: Callable[[], DatasetSettings]
    """Function that returns the settings of the dataset."""
    num_scenes: int
    """Number of scenes to make unless the user asks for another."""
    scene_digest: str | None = None
    """Expected digest of the scenes of a frozen set (storage.dataset.statistics), checked when the
    dataset has `num_scenes` scenes."""
    device: Device = "auto"
    """Device that renders a new dataset by default: `cpu` where a digest of pictures is known."""
