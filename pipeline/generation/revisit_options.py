"""`trilight revisit`: converts its options to options of the new dataset."""

import os
import re
from collections.abc import Mapping
from dataclasses import field, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from pipeline.exchange.reader import load_cameras, scene_source
from pipeline.generation.generate_options import GenerateOptions
from pipeline.presets.settings import MOST_CAMERAS, GivenCamera, RevisitSettings
from pipeline.renders.mitsuba_variant import Device
from pipeline.renders.settings import NoiseFloor, Resolution
from pipeline.shards.finished_dataset import open_finished
from scene_templates.templates import TEMPLATES
from storage.errors import TrilightError
from storage.settings.described import checked, settings_record
from storage.settings.ranges import Seed, Share, Within

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
        c2w, fov_deg = load_cameras(scene_source(words))
        if len(c2w) > MOST_CAMERAS:
            raise TrilightError(f"--cameras {words}: {len(c2w)}; expected up to {MOST_CAMERAS}.")
        cameras = tuple(
            GivenCamera(c2w=tuple(pose.ravel().tolist()), fov_deg=float(angle))
            for pose, angle in zip(c2w, fov_deg, strict=True)
        )
        return {"kept_cameras": 0, "given_cameras": cameras}
    layouts = ", ".join(TEMPLATES)
    raise TrilightError(f"--cameras is {words!r}; {_CAMERAS} (layouts: {layouts}).")


def _lights(words: str) -> dict[str, Any]:
    if words in ("keep", "new"):
        return {"lights": words}
    if words.isascii() and words.isdecimal():
        return {"lights": "new", "num_lights": int(words)}
    raise TrilightError(f"--lights is {words!r}; {_LIGHTS}.")
