"""`DatasetOrder`: what a person says of a dataset, on the command line or in a scheduler's form."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pipeline.flows.builds import BUILDS
from storage.errors import TrilightError
from storage.output import dataset_folder

_RANGE = re.compile(r"(\d+):(\d+)")


@dataclass(frozen=True, kw_only=True)
class DatasetOrder:
    """Which dataset to make, or which part of it, and how."""

    build: str = "smoke"
    """Named settings, such as smoke or pretrain-256."""
    objects: str | None = None
    """Source of 3D objects: a folder here or on a server, builtin:, objaverse:, or env:NAME for
    what the environment variable NAME of the worker says. By default what the build demands, or
    else builtin:."""
    out: str = "data/smoke"
    """Folder of the dataset, as the worker sees it, or a bucket such as s3://bucket/folder. With a
    bucket, machines that work at the same time should make different shards, or they waste work."""
    scenes: int | None = None
    """How many scenes, rounded up to whole shards; by default the build's number."""
    seed: int | None = None
    """Replaces the build's seed of every draw."""
    resolution: int | None = None
    """Replaces the build's picture width in pixels."""
    noise_floor_db: float | None = None
    """Replaces the build's target (psnr_log_db)."""
    allow_licences: tuple[str, ...] = ()
    """Licences allowed in addition to the build's."""
    licence: str | None = None
    """Licence of object files that come without any statement; otherwise they count as yours."""
    workers: int | None = None
    """Render processes that share the cores; by default one, or one for each graphics card."""
    failure_budget: float = 0.1
    """Share of scenes that may be given up before the run stops."""
    accept_environment: bool = False
    """Go on with a dataset that was begun with other library versions."""
    scenes_from: str | None = None
    """Folder of scene files (RenderFormer JSON) to render instead of new scenes: scene k is the
    k-th *.json, all are of the split test, and the build's limits on scenes do not apply."""
    views: int | None = None
    """First cameras of each scene file; by default as many as every file has."""
    shards: str | None = None
    """A range of shards A:B, from A up to but not B: make these only. Whoever makes the last
    missing shard of a dataset finishes it."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Other settings of the build by dotted name, such as scenes.lights.count."""

    def __post_init__(self) -> None:
        if self.build not in BUILDS:
            names = ", ".join(BUILDS)
            raise TrilightError(f"build {self.build!r} is unknown; expected one of {names}.")
        if self.scenes is not None and self.scenes < 1:
            raise TrilightError(f"scenes is {self.scenes}; expected at least 1.")
        if self.workers is not None and self.workers < 1:
            raise TrilightError(f"workers is {self.workers}; expected at least 1.")
        if not 0 <= self.failure_budget <= 1:
            raise TrilightError(
                f"failure_budget is {self.failure_budget}; expected a share from 0 to 1."
            )
        if self.scenes_from is not None and (self.objects, self.scenes) != (None, None):
            raise TrilightError(
                f"--scenes-from {self.scenes_from} was given with --objects or --scenes; expected "
                "neither: the files say both."
            )
        if self.scenes_from is None and self.views is not None:
            raise TrilightError(f"--views is {self.views}; expected it only with --scenes-from.")
        dataset_folder(self.out)
        self.shard_range()

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
