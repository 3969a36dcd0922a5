"""Views per core-hour by noise floor, at 256 and 512 pixels, and what millions of them would cost.

Each view is rendered to every target, with the passes that the targets share traced once
(infra.bench.renders.ladder). Composing and loading a scene are not part of a view: a build shares
them among the views of the scene, and the loading is stated apart.
"""

import contextlib
import dataclasses
import functools
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from infra.bench.cycles.comparison import NamedScene
from infra.bench.harness import Options, Result, machine
from infra.bench.render_child import smoke_child
from infra.bench.renders.kept import Kept
from infra.bench.renders.ladder import Ladder, render_ladder
from infra.bench.renders.named_set import named_set
from pipeline.isolation import IsolatedChild

NAME = "render-throughput"
MANY_VIEWS = 8_000_000
_SEED = 20_261_121


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is rendered."""

    scenes: tuple[str, ...]
    """Names in the set; the first view of each."""
    resolutions: tuple[int, ...]
    """Pixels each way."""
    targets_db: tuple[float, ...]
    """Noise floors, psnr_log_db."""
    max_spp: int
    """The cap."""
    threads: int
    """Of the child."""


@dataclass(frozen=True, kw_only=True)
class View:
    """One view at one target."""

    scene: str
    """Of the named set."""
    resolution: int
    """Pixels each way."""
    target_db: float
    """Noise floor that was asked for."""
    noise_floor_db: float
    """What was measured."""
    reached: bool
    """Whether it is the target or better."""
    spp: int
    """Samples per pixel."""
    core_s: float
    """Core-seconds, scene loaded and kernels warm."""
    load_core_s: float
    """Core-seconds of loading the scene."""


@dataclass(frozen=True, kw_only=True)
class Economy:
    """All views of one resolution at one target."""

    resolution: int
    """Pixels each way."""
    target_db: float
    """Noise floor that was asked for."""
    num_views: int
    """How many were rendered."""
    views_per_core_hour: float
    """One hour by the mean core-seconds of a view, whether it reached the target or the cap."""
    share_reached: float
    """Of the views, under the cap."""
    median_floor_db: float
    """Over the views."""
    p5_floor_db: float
    """5th percentile."""
    mean_spp: float
    """Samples per pixel."""
    load_core_s: float
    """Mean core-seconds of loading a scene, not in the figures above."""
    usd_for_many: float
    """What MANY_VIEWS views cost at the stated price."""


@dataclass(frozen=True, kw_only=True)
class Throughput(Result):
    """All views, and what they say."""

    plan: Plan
    """What was rendered."""
    views: tuple[View, ...]
    """Scene by scene."""
    economies: tuple[Economy, ...]
    """By resolution, then target."""
    usd_per_core_hour: float
    """The price."""
    num_resumed: int
    """Scenes that an earlier, interrupted run measured."""


def num_rounds(options: Options) -> int:
    """Return how often `round_done` will be called."""
    plan = _plan(options, _chosen(options))
    return len(plan.scenes) * len(plan.resolutions)


def run(options: Options, round_done: Callable[[], None]) -> Throughput:
    """Measure; quickly three scenes with at most 512 samples, otherwise twelve with 1024.

    Raises:
        TrilightError: the folder of scenes holds none.
    """
    chosen = _chosen(options)
    return measure(chosen, _plan(options, chosen), options, round_done)


def measure(
    chosen: Sequence[NamedScene], plan: Plan, options: Options, round_done: Callable[[], None]
) -> Throughput:
    """Render every view; see `run`."""
    here = machine()
    kept = Kept(NAME, {**here, **dataclasses.asdict(plan)}, resume=options.resume)
    records: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        with contextlib.closing(smoke_child(Path(folder), threads=plan.threads)) as child:
            for named in chosen:
                for resolution in plan.resolutions:
                    render = functools.partial(_records, named, resolution, plan, child)
                    records += kept.item(f"{named.name}, {resolution}", render)
                    round_done()
    kept.forget()
    views = tuple(View(**record) for record in records)
    return Throughput(
        name=NAME,
        machine=here,
        plan=plan,
        views=views,
        economies=economies(views, plan, options.usd_per_core_hour),
        usd_per_core_hour=options.usd_per_core_hour,
        num_resumed=kept.num_resumed,
    )


def _chosen(options: Options) -> list[NamedScene]:
    """Return scenes from all over the set."""
    every, count = named_set(options.scenes), 3 if options.quick else 12
    return [every[row * len(every) // count] for row in range(count)]


def _plan(options: Options, chosen: Sequence[NamedScene]) -> Plan:
    return Plan(
        scenes=tuple(named.name for named in chosen),
        resolutions=(256, 512),
        targets_db=(38.0, 42.0, 46.0, 50.0),
        max_spp=512 if options.quick else 1024,
        threads=os.cpu_count() or 1,
    )


def _records(
    named: NamedScene, resolution: int, plan: Plan, child: IsolatedChild
) -> list[dict[str, Any]]:
    ladder: Ladder = child.call(
        render_ladder, named.make(child), resolution, plan.targets_db, plan.max_spp, _SEED
    )
    views = [
        View(
            scene=named.name,
            resolution=resolution,
            target_db=rung.target_db,
            noise_floor_db=rung.view.noise_floor_db,
            reached=rung.reached,
            spp=rung.view.spp,
            core_s=rung.core_s,
            load_core_s=ladder.load_core_s,
        )
        for rung in ladder.rungs
    ]
    return [dataclasses.asdict(view) for view in views]


def economies(views: Sequence[View], plan: Plan, usd_per_core_hour: float) -> tuple[Economy, ...]:
    """Return the views by resolution and target."""
    return tuple(
        _economy(
            [view for view in views if (view.resolution, view.target_db) == (resolution, target)],
            usd_per_core_hour,
        )
        for resolution in plan.resolutions
        for target in plan.targets_db
    )


def _economy(views: Sequence[View], usd_per_core_hour: float) -> Economy:
    core_s = float(np.mean([view.core_s for view in views]))
    floors = [view.noise_floor_db for view in views]
    return Economy(
        resolution=views[0].resolution,
        target_db=views[0].target_db,
        num_views=len(views),
        views_per_core_hour=3600 / core_s,
        share_reached=float(np.mean([view.reached for view in views])),
        median_floor_db=float(np.median(floors)),
        p5_floor_db=float(np.percentile(floors, 5)),
        mean_spp=float(np.mean([view.spp for view in views])),
        load_core_s=float(np.mean([view.load_core_s for view in views])),
        usd_for_many=MANY_VIEWS * core_s / 3600 * usd_per_core_hour,
    )
