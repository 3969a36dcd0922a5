"""Options of `trilight generate`, also for a scheduler's form, and those of `trilight revisit`."""

import os
import re
from collections.abc import Mapping
from dataclasses import field, fields
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from pipeline.exchange.from_description import AlbedoOverOne
from pipeline.objects.generated import BENCHMARK
from pipeline.objects.generated import PREFIX as BUILTIN
from pipeline.presets.registry import DATASET_PRESETS, preset_settings
from pipeline.presets.settings import MOST_CAMERAS, DatasetSettings, GivenCamera, RevisitSettings
from pipeline.renders.mitsuba_variant import Device
from pipeline.renders.settings import NoiseFloor, Resolution
from pipeline.shards.finished_dataset import open_finished
from scene_templates.templates import TEMPLATES
from storage.aliases import OBJECTS, stored_name
from storage.dataset.layout import DatasetFolder, dataset_folder
from storage.dataset.settings import MOST_SCENES
from storage.errors import TrilightError
from storage.extensions import function_name
from storage.records.objects import SKY, TEXTURE
from storage.remote.url import safe_url
from storage.settings.described import checked, settings_record
from storage.settings.fields import option_of
from storage.settings.overrides import option_words
from storage.settings.ranges import Seed, Share, Within

_RANGE = re.compile(r"(\d+):(\d+)")
_OF_COMPOSED = ("objects", "scenes", "textures", "skies")
_EXCLUDED = {"scenes_from": _OF_COMPOSED, "revisits": (*_OF_COMPOSED, "scenes_from")}
"""Options that cannot be given with an option, as that one says what scenes are made of."""
_NEEDS = {"map_licence": ("textures", "skies"), "views": ("scenes_from",)}
"""Options of which one must be given with an option."""
_PER_MACHINE = ("build", "out", "shards", "workers")
"""Fields that differ from machine to machine: folder, range of shards, number of processes."""


PRICES = Within(0, 1000, unit="USD per core-hour")
"""Range of prices; its upper end is ten thousand times the usual rent of a core."""


@checked()
class CorePrice:
    """The price of computing."""

    price: Annotated[float, PRICES] = 0.04
    """Price of one core for an hour, in USD."""


@checked()
class GenerateOptions:
    """The dataset to make, the range of its shards, and how."""

    build: str = "smoke"
    """Dataset preset, such as tiny or pretrain-256; `trilight presets` lists them."""
    objects: str | None = None
    """Source of 3D objects: a folder, a URL, procedural:, objaverse:, or env:TRILIGHT_SOURCE_NAME,
    the variable of a worker that holds the source; by default the preset's, or procedural:."""
    out: str | None = None
    """Folder or bucket (s3://bucket/folder) for the dataset, on the machine that makes it; by
    default data/PRESET."""
    scenes: Annotated[int | None, Within(1, MOST_SCENES, unit="scenes")] = None
    """Number of scenes; a larger one lets a dataset grow; by default the preset's."""
    seed: Seed | None = None
    """Seed of objects, scenes, cameras and samples; by default the preset's."""
    resolution: Resolution | None = None
    """Width of an image in pixels; by default the preset's."""
    noise_floor_db: NoiseFloor | None = None
    """Target for the stated error in dB (psnr_log_db; higher is cleaner), where sampling stops; by
    default the preset's, unless another target is given. Of several, all are reached."""
    noise_floor_linear_db: NoiseFloor | None = None
    """The same as psnr_linear_db, of radiance clamped to [0, 1]; by default the preset's, unless
    another target is given."""
    noise_floor_objects_db: NoiseFloor | None = None
    """The same as object_psnr_log_db, which leaves out empty background; by default the preset's,
    unless another target is given."""
    allow_licences: tuple[str, ...] = ()
    """Licenses to allow in addition to the preset's; by default there are none."""
    licence: str | None = None
    """License of object files that state none; by default such files count as your own work."""
    textures: str | None = None
    """Folder of your own textures: base colors, with their maps beside them; by default all
    textures are procedural. The settings scenes.textures say how many are used."""
    skies: str | None = None
    """Folder of your own environment maps, .hdr or .exr; by default all skies are procedural. The
    settings scenes.skies say how many are used."""
    map_licence: str | None = None
    """License of textures and maps of folders without a catalog; by default such files count as
    your own work."""
    workers: Annotated[int | None, Within(1, 1024, unit="processes")] = None
    """Number of render processes, which share the cores; by default one, or up to four a GPU."""
    device: Device | None = None
    """Device that renders: cpu, gpu, or auto (a GPU that renders a test scene correctly). The first
    run of a dataset decides; by default cpu for tiny and frozen presets, auto for others."""
    failure_budget: Share = 0.1
    """Share of scenes that may fail for good before the run stops."""
    accept_environment: bool = False
    """Continue a dataset that was started with other library versions or on another device."""
    scenes_from: str | None = None
    """Folder of scene files (RenderFormer JSON) to render; by default scenes are composed of
    objects. Scene k is the k-th *.json. All scenes belong to the test split. The preset's limits
    on scenes do not apply."""
    views: Annotated[int | None, Within(1, 1000, unit="cameras")] = None
    """Number of cameras to use of each scene file, from its first; by default the smallest number
    of cameras in any file."""
    albedo_over_one: AlbedoOverOne = "scale"
    """How to treat a material of a scene file whose diffuse and specular albedos add up to more
    than 1: scale multiplies both by one factor, refuse leaves the file out."""
    revisits: str | None = None
    """Folder of a finished dataset to render again by the settings `revisit`, which `trilight
    revisit` writes; by default scenes are composed of objects."""
    shards: str | None = None
    """Range A:B of the shards to make, from A up to but not including B; by default all. The run
    that makes the last missing shard finishes the dataset."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Changes to the preset's settings, by dotted name, such as scenes.lights.coloured_share=0.5
    (values are JSON); by default there are none."""

    def __post_init__(self) -> None:
        DATASET_PRESETS.find(self.build)
        stated = [name for name, value in vars(self).items() if value is not None]
        for name, excluded in _EXCLUDED.items():
            if name in stated and (wrong := [other for other in excluded if other in stated]):
                raise TrilightError(
                    f"{option_of(name)} {getattr(self, name)} was given with "
                    f"{' and '.join(map(option_of, wrong))}; expected it without: it says what "
                    "scenes are made of. Leave one out."
                )
        for name, necessary in _NEEDS.items():
            if name in stated and not {*necessary} & {*stated}:
                raise TrilightError(
                    f"{option_of(name)} is {getattr(self, name)!r}; expected it only with "
                    f"{' or '.join(map(option_of, necessary))}."
                )
        dataset_folder(self.place)
        self.shard_range()

    @property
    def num_scenes(self) -> int:
        return DATASET_PRESETS[self.build].num_scenes if self.scenes is None else self.scenes

    @cached_property
    def settings(self) -> DatasetSettings:
        """The preset's settings with the changes of these options.

        Raises:
            TrilightError: values contradict each other.
        """
        return preset_settings(
            self.build,
            seed=self.seed,
            resolution=self.resolution,
            noise_targets=vars(self),
            allow_licences=self.allow_licences,
            changes=self.changes,
        )

    @property
    def source(self) -> str:
        """Source of the objects, as `list_objects` takes it; may hold a secret.

        Raises:
            TrilightError: the preset is frozen with another source than the given one.
        """
        objects = self.objects and stored_name(self.objects, OBJECTS)
        settings = self.settings
        if settings.source is None:
            # An evaluated network may have been trained on the built-in objects.
            return objects or (BENCHMARK if settings.splits.one_split else BUILTIN)
        if objects is not None and objects != settings.source:
            raise TrilightError(
                f"--objects is {safe_url(objects)!r}; expected {settings.source!r}, the "
                f"fixed source of {settings.build}. Omit --objects, or choose another build."
            )
        return settings.source

    def map_folders(self) -> Mapping[str, str]:
        """Return the given folders of textures and maps, by kind.

        Raises:
            TrilightError: a folder is given that no scene would use, or scenes need a folder that
                is not given.
        """
        folders = {}
        for kind, name in ((TEXTURE, "textures"), (SKY, "skies")):
            folder = getattr(self, name)
            drawn = getattr(self.settings.scenes, name)
            is_used = bool(drawn.share and drawn.own_share)
            if folder is None and is_used:
                raise TrilightError(
                    f"scenes.{name}.own_share is {drawn.own_share:g}, but --{name} is not given; "
                    f"expected a folder. Add --{name} FOLDER, or --set scenes.{name}.own_share=0."
                )
            if folder is not None and not is_used:
                raise TrilightError(
                    f"--{name} is given, but scenes.{name}.share is {drawn.share:g} and own_share "
                    f"{drawn.own_share:g}; expected both above 0. Add --set scenes.{name}.share="
                    f"0.5 --set scenes.{name}.own_share=1, or leave --{name} out."
                )
            if folder is not None:
                folders[kind] = folder
        return folders

    @property
    def place(self) -> str:
        return f"data/{function_name(self.build)}" if self.out is None else self.out

    @property
    def folder(self) -> DatasetFolder:
        return dataset_folder(self.place)

    def shard_range(self) -> range | None:
        """Return the range of requested shards, or None for all.

        Raises:
            TrilightError: `shards` is no range, or an empty one.
        """
        if self.shards is None:
            return None
        match = _RANGE.fullmatch(self.shards)
        if match is None or int(match[1]) >= int(match[2]):
            raise TrilightError(
                f"shards is {self.shards!r}; expected a range such as 0:8, from the first shard up "
                "to but not including the last."
            )
        return range(int(match[1]), int(match[2]))


def generate_words(options: GenerateOptions) -> list[str]:
    """Return the arguments of `generate` that repeat these options, without `--out`.

    Options of this machine alone (the range of shards, the number of processes) are left out; so
    are passwords.
    """
    words = option_words(options, leave_out=_PER_MACHINE)
    safe_words = (safe_url(word) if "://" in word else word for word in words)
    return ["generate", options.build, *safe_words]


_DRAWN = re.compile(r"(?:(?P<layout>\w+):)?(?P<count>\d{1,6})", re.ASCII)
_CAMERAS = (
    "expected keep; a number, such as 4, for so many views of each scene, those that it has first; "
    "new:4 for new cameras only; a layout and a number, such as plane:4; or a file with cameras"
)
_LIGHTS = "expected keep, new, or a number of new lights, such as 3"


@checked()
class RevisitOptions:
    """The finished dataset, and the changes to its scenes."""

    dataset: str
    """Folder of a finished dataset."""
    out: str
    """Folder of the new dataset, or a bucket such as s3://bucket/folder. Run the same command again
    to resume."""
    cameras: str = "keep"
    """Cameras of each scene: keep; 4 for four, the present ones first; new:4 for new ones only;
    plane:4 for new ones as another layout has them; or a file with cameras for every scene
    (RenderFormer JSON, USD, or any scene)."""
    lights: str = "keep"
    """Lights of each scene: keep; new for as many new ones; or a number of new ones, such as 3.
    `--set scenes.lights.NAME=VALUE` changes what they are drawn from."""
    materials: Literal["keep", "new"] = "keep"
    """Materials of each scene: keep, or new ones. `--set scenes.materials.NAME=VALUE`
    changes what they are drawn from."""
    seed: Seed | None = None
    """Seed of new draws and samples; another one renders every image; by default the
    dataset's."""
    resolution: Resolution | None = None
    """Width of an image in pixels; by default the dataset's."""
    noise_floor_db: NoiseFloor | None = None
    """Stated error in dB (psnr_log_db) at which sampling stops; by default as the dataset was
    made."""
    noise_floor_linear_db: NoiseFloor | None = None
    """The same as psnr_linear_db; by default as the dataset was made. Of several errors, all are
    reached."""
    noise_floor_objects_db: NoiseFloor | None = None
    """The same as object_psnr_log_db; by default as the dataset was made."""
    build: str | None = None
    """Preset for settings that a merged dataset does not state; by default the dataset's own."""
    workers: Annotated[int | None, Within(1, 1024, unit="processes")] = None
    """Number of render processes, which share the cores; by default one, or four for each GPU, or
    as many as its memory holds."""
    device: Device | None = None
    """Device that renders: cpu, gpu or auto; by default as `trilight generate` with its preset."""
    failure_budget: Share = 0.1
    """Share of scenes that may fail for good before the run stops."""
    accept_environment: bool = False
    """Continue a dataset that was started with other library versions or on another device."""
    shards: str | None = None
    """Range A:B of the shards to make, from A up to but not including B; by default all."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Changes to the dataset's settings, by dotted name, such as storage.passes=[depth,normal]
    (values are JSON); by default there are none."""


def to_generate_options(options: RevisitOptions) -> GenerateOptions:
    """Return the options of the new dataset, without the settings of the finished one.

    Raises:
        TrilightError: the dataset is unfinished, or an option is malformed.
    """
    manifest = open_finished(options.dataset).manifest
    revisit = RevisitSettings(
        source_digest=manifest.dataset_digest,
        **_cameras(options.cameras, manifest.num_views),
        **_lights(options.lights),
        materials=options.materials,
    )
    same = {
        each.name: getattr(options, each.name)
        for each in fields(GenerateOptions)
        if hasattr(options, each.name)
    }
    stated = {
        "build": options.build or manifest.build,
        "revisits": os.path.realpath(options.dataset),
        "changes": {**options.changes, "revisit": settings_record(revisit)},
    }
    return GenerateOptions(**{**same, **stated})


def _cameras(words: str, num_views: int) -> dict[str, Any]:
    if words == "keep":
        return {"kept_cameras": num_views}
    if drawn := _DRAWN.fullmatch(words):
        layout = drawn["layout"]
        count = int(drawn["count"])
        if layout is None:
            num_kept = min(count, num_views)
            return {"kept_cameras": num_kept, "new_cameras": count - num_kept}
        if layout == "new":
            return {"kept_cameras": 0, "new_cameras": count}
        if layout in TEMPLATES:
            return {"kept_cameras": 0, "new_cameras": count, "camera_layout": layout}
    if Path(words).is_file():
        from pipeline.exchange.reader import SceneReader, scene_source  # slow: every reader

        with SceneReader() as reader:
            cameras = reader.cameras(scene_source(words))
        if len(cameras) > MOST_CAMERAS:
            raise TrilightError(
                f"--cameras {words}: {len(cameras)}; expected up to {MOST_CAMERAS}."
            )
        settings = tuple(
            GivenCamera(c2w=tuple(camera.c2w.ravel().tolist()), fov_deg=camera.fov_deg)
            for camera in cameras
        )
        return {"kept_cameras": 0, "given_cameras": settings}
    layouts = ", ".join(TEMPLATES)
    raise TrilightError(f"--cameras is {words!r}; {_CAMERAS} (layouts: {layouts}).")


def _lights(words: str) -> dict[str, Any]:
    if words in ("keep", "new"):
        return {"lights": words}
    if words.isascii() and words.isdecimal():
        return {"lights": "new", "num_lights": int(words)}
    raise TrilightError(f"--lights is {words!r}; {_LIGHTS}.")
