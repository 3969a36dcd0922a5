"""`DatasetOrder`: what a person says of a dataset, on the command line or in a scheduler's form."""

import re
from collections.abc import Mapping
from dataclasses import field
from typing import Annotated, Any

from pipeline.builds.named import BUILDS
from pipeline.exchange.from_description import AlbedoOverOne
from pipeline.renders.settings import NoiseFloor, Resolution
from storage.dataset.layout import dataset_folder
from storage.dataset.settings import MOST_SCENES
from storage.errors import TrilightError
from storage.extensions import function_name
from storage.remote.safe_url import safe_url
from storage.settings.described import checked, option_words
from storage.settings.ranges import Seed, Share, Within

_RANGE = re.compile(r"(\d+):(\d+)")
_ELSEWHERE = ("build", "out", "shards", "workers")
"""What another machine says otherwise: where, which part, with how many processes."""


@checked()
class DatasetOrder:
    """Which dataset to make, or which part of it, and how."""

    build: str = "smoke"
    """Named settings, such as smoke or pretrain-256."""
    objects: str | None = None
    """Source of 3D objects: a folder here or on a server, builtin:, objaverse:, or
    env:TRILIGHT_SOURCE_NAME for what that environment variable of the worker says. By default what
    the build demands, or else builtin:."""
    out: str | None = None
    """Folder of the dataset, as the worker sees it, or a bucket such as s3://bucket/folder; by
    default data/BUILD. With a bucket, machines that work at the same time should make different
    shards, or they waste work."""
    scenes: Annotated[int | None, Within(1, MOST_SCENES, unit="scenes")] = None
    """How many scenes, rounded up to whole shards; by default the build's number."""
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
    """Licences allowed in addition to the build's, which are the default."""
    licence: str | None = None
    """Licence of object files that come without any statement; by default they count as yours."""
    workers: Annotated[int | None, Within(1, 1024, unit="processes")] = None
    """Render processes that share the cores; by default one, or one for each graphics card."""
    failure_budget: Share = 0.1
    """Share of scenes that may be given up before the run stops."""
    accept_environment: bool = False
    """Go on with a dataset that was begun with other library versions."""
    scenes_from: str | None = None
    """Folder of scene files (RenderFormer JSON) to render instead of new scenes, which are the
    default: scene k is the k-th *.json, all are of the split test, and the build's limits on scenes
    do not apply."""
    views: Annotated[int | None, Within(1, 1000, unit="cameras")] = None
    """First cameras of each scene file; by default as many as every file has."""
    albedo_over_one: AlbedoOverOne = "scale"
    """What to do with a material of a scene file whose diffuse and specular albedos add up to more
    than 1: scale multiplies both by one number, refuse leaves the file out."""
    shards: str | None = None
    """A range of shards A:B, from A up to but not B: make these only, by default all. Whoever makes
    the last missing shard of a dataset finishes it."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Other settings of the build by dotted name, such as scenes.lights.coloured_share=0.5 (values
    are JSON); by default none differ."""

    def __post_init__(self) -> None:
        BUILDS.find(self.build)
        if self.scenes_from is not None and (self.objects, self.scenes) != (None, None):
            raise TrilightError(
                f"--scenes-from {self.scenes_from} was given with --objects or --scenes; expected "
                "neither: the files say both."
            )
        if self.scenes_from is None and self.views is not None:
            raise TrilightError(f"--views is {self.views}; expected it only with --scenes-from.")
        dataset_folder(self.place)
        self.shard_range()

    @property
    def place(self) -> str:
        """Where the dataset is made."""
        return f"data/{function_name(self.build)}" if self.out is None else self.out

    def shard_range(self) -> range | None:
        """Return the shards that are asked for, or None for all.

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


def generate_words(order: DatasetOrder) -> list[str]:
    """Return the words of `generate` for what an order asks beside its defaults, without `--out`.

    Which part of the dataset this machine makes, and with how many processes, is left out; so are
    passwords.
    """
    words = option_words(order, leave_out=_ELSEWHERE)
    return ["generate", order.build, *map(_shown, words)]


def _shown(word: str) -> str:
    return safe_url(word) if "://" in word else word
