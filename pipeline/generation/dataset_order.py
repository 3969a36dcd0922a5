"""`DatasetOrder`: the options of `trilight generate`, also for a scheduler's form."""

import re
from collections.abc import Mapping
from dataclasses import field
from typing import Annotated, Any

from pipeline.builds.named import BUILDS
from pipeline.exchange.from_description import AlbedoOverOne
from pipeline.renders.settings import NoiseFloor, NoiseTargets, Resolution
from pipeline.renders.variant import Device
from storage.dataset.layout import dataset_folder
from storage.dataset.settings import MOST_SCENES
from storage.errors import TrilightError
from storage.extensions import function_name
from storage.remote.safe_url import safe_url
from storage.settings.changes import option_words
from storage.settings.described import checked
from storage.settings.ranges import Seed, Share, Within

_RANGE = re.compile(r"(\d+):(\d+)")
_PER_MACHINE = ("build", "out", "shards", "workers")
"""Fields that differ from machine to machine: folder, range of shards, number of processes."""


@checked()
class DatasetOrder:
    """The dataset to make, the range of its shards, and how."""

    build: str = "smoke"
    """Name of a build (a named set of settings), such as smoke or pretrain-256."""
    objects: str | None = None
    """Source of 3D objects: a folder or a URL, builtin:, objaverse:, or env:TRILIGHT_SOURCE_NAME,
    which reads the source from that environment variable of the worker. By default the source that
    the build requires, or else builtin:."""
    out: str | None = None
    """Folder for the dataset, on the machine that makes it, or a bucket such as s3://bucket/folder;
    by default data/BUILD. Machines that write to one bucket at the same time should make different
    shards, or they make the same scenes twice."""
    scenes: Annotated[int | None, Within(1, MOST_SCENES, unit="scenes")] = None
    """Number of scenes; by default the build's. With a larger number, the same command lets the
    dataset grow."""
    seed: Seed | None = None
    """Seed of objects, scenes, cameras and samples; by default the build's."""
    resolution: Resolution | None = None
    """Width of a picture in pixels; by default the build's."""
    noise_floor_db: NoiseFloor | None = None
    """Sampling stops at this measured noise floor in dB (psnr_log_db; higher is cleaner); by
    default the build's, unless another floor is asked for. Of several, all are reached."""
    noise_floor_linear_db: NoiseFloor | None = None
    """Sampling stops at this floor as psnr_linear_db, of radiance clamped to [0, 1], 5 to 10 dB
    below psnr_log_db in most pictures; by default the build's, unless another floor is asked
    for."""
    noise_floor_objects_db: NoiseFloor | None = None
    """Sampling stops at this floor as object_psnr_log_db, in which empty background does not
    count; by default the build's, unless another floor is asked for."""
    allow_licences: tuple[str, ...] = ()
    """Licences to allow in addition to the build's; by default there are none."""
    licence: str | None = None
    """Licence of object files that state none; by default such files count as your own work."""
    textures: str | None = None
    """Folder of your own textures: base colours, with their maps beside them; by default all
    textures are procedural. The settings scenes.textures say how many are used."""
    skies: str | None = None
    """Folder of your own environment maps, .hdr or .exr; by default all skies are procedural. The
    settings scenes.skies say how many are used."""
    map_licence: str | None = None
    """Licence of textures and maps of folders without a catalogue; by default such files count as
    your own work."""
    workers: Annotated[int | None, Within(1, 1024, unit="processes")] = None
    """Number of render processes, which share the cores; by default one, or four for each GPU, or
    as many as its memory holds."""
    device: Device | None = None
    """Device that renders: cpu, gpu, or auto, a GPU where one gives the right picture of a small
    scene. It is chosen when a dataset begins and stands in its manifest; by default cpu for smoke
    and the frozen builds, auto for others."""
    failure_budget: Share = 0.1
    """Share of scenes that may fail for good before the run stops."""
    accept_environment: bool = False
    """Continue a dataset that was started with other library versions or on another device."""
    scenes_from: str | None = None
    """Folder of scene files (RenderFormer JSON) to render; by default scenes are composed of
    objects. Scene k is the k-th *.json, all scenes belong to the split test, and the build's limits
    on scenes do not apply."""
    views: Annotated[int | None, Within(1, 1000, unit="cameras")] = None
    """Number of cameras to use of each scene file, from its first; by default the smallest number
    of cameras in any file."""
    albedo_over_one: AlbedoOverOne = "scale"
    """How to treat a material of a scene file whose diffuse and specular albedos add up to more
    than 1: scale multiplies both by one factor, refuse leaves the file out."""
    revisits: str | None = None
    """Folder of a finished dataset whose scenes to render again, with what the settings `revisit`
    say is new (`trilight revisit` writes them); by default scenes are composed of objects."""
    shards: str | None = None
    """Range A:B of the shards to make, from A up to but not including B; by default all. The run
    that makes the last missing shard finishes the dataset."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Changes to the build's settings, by dotted name, such as scenes.lights.coloured_share=0.5
    (values are JSON); by default there are none."""

    def __post_init__(self) -> None:
        BUILDS.find(self.build)
        if self.scenes_from is not None and (self.objects, self.scenes) != (None, None):
            raise TrilightError(
                f"--scenes-from {self.scenes_from} was given with --objects or --scenes; expected "
                "neither: the files say both."
            )
        if (
            self.revisits is not None
            and (self.objects, self.scenes, self.scenes_from) != (None,) * 3
        ):
            raise TrilightError(
                f"--revisits {self.revisits} was given with --objects, --scenes or --scenes-from; "
                "expected none of them: the dataset says all."
            )
        _refuse_maps(self)
        if self.scenes_from is None and self.views is not None:
            raise TrilightError(f"--views is {self.views}; expected it only with --scenes-from.")
        dataset_folder(self.place)
        self.shard_range()

    @property
    def noise_targets(self) -> NoiseTargets:
        """The target errors."""
        return NoiseTargets(
            log_db=self.noise_floor_db,
            linear_db=self.noise_floor_linear_db,
            objects_db=self.noise_floor_objects_db,
        )

    @property
    def place(self) -> str:
        """Path or URL of the dataset."""
        return f"data/{function_name(self.build)}" if self.out is None else self.out

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


def _refuse_maps(order: DatasetOrder) -> None:
    """Raise if map folders are given for scenes that are not composed, or a licence without any."""
    for name, value in (("--textures", order.textures), ("--skies", order.skies)):
        if value is not None and (order.scenes_from or order.revisits):
            raise TrilightError(
                f"{name} was given with --scenes-from or --revisits; expected it only where scenes "
                "are composed. Leave it out."
            )
    if order.map_licence is not None and order.textures is None and order.skies is None:
        raise TrilightError(
            f"--map-licence is {order.map_licence!r}; expected it only with --textures or --skies."
        )


def generate_words(order: DatasetOrder) -> list[str]:
    """Return the arguments of `generate` that repeat these options, without `--out`.

    Options of this machine alone (the range of shards, the number of processes) are left out; so
    are passwords.
    """
    words = option_words(order, leave_out=_PER_MACHINE)
    return ["generate", order.build, *map(_hide_secret, words)]


def _hide_secret(word: str) -> str:
    return safe_url(word) if "://" in word else word
