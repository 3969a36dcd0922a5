"""Our renderer beside plain Mitsuba and Blender's Cycles: cost at equal true error.

Errors are true ones, to raw samples of our own tracer in two halves, which no denoiser has seen:
their noise cancels. Where another renderer transports light differently it cannot come nearer than
that difference, as its error at many samples shows. The sides take turns on every scene.
"""

import dataclasses
import os
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from infra.bench.curve import PricedLevel, at_error
from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Point, TurnFigures, percent
from infra.bench.experiments.sampling import CORE_S, DB, WORST
from infra.bench.sides.judged_pictures import Reference, raw_reference, true_error_db
from infra.bench.sides.sampled_pictures import first_camera, render_levels
from infra.bench.sides.shots import SEED, shots
from infra.bench.subjects.named_scenes import NUM_SAMPLED, sampled_names
from infra.bench.workshop import Workshop
from pipeline.builds.training import pretrain_256
from pipeline.renders.noise_floor import clamped_radiance
from pipeline.renders.settings import RenderSettings
from storage.conventions import log10_radiance
from storage.records.scene import Scene

TARGETS_DB = (38.0, 42.0, 46.0, 50.0)
BROKEN_DB = 1.0
"""A stated floor that is better than the truth by more than this is wrong."""

Picture = NDArray[np.float32]


def adaptive(target_db: float, resolution: int, max_spp: int) -> RenderSettings:
    """Return the settings of `pretrain-256` with another target, width and cap."""
    return dataclasses.replace(
        pretrain_256().renders,
        resolution=resolution,
        noise_floor_db=target_db,
        max_spp=max_spp,
        min_mean_radiance=0.0,
    )


def _ours(effort: Effort) -> list[Point]:
    return [
        Point(
            name=f"trilight {target_db:.0f} dB",
            settings=adaptive(target_db, effort.resolution, effort.max_spp),
            default=target_db == pretrain_256().renders.noise_floor_db,
        )
        for target_db in TARGETS_DB
    ]


def _mitsuba(effort: Effort) -> list[Point]:
    """Return fixed numbers of samples up to four times our cap."""
    doublings = range((4 * effort.max_spp // 64).bit_length())
    return [Point(name=f"mitsuba {64 << step}", settings=64 << step) for step in doublings]


def _cycles(effort: Effort) -> list[Point]:
    most = 4 * effort.max_spp
    return [Point(name=f"cycles {spp}", settings=spp) for spp in (128, most) if spp <= most]


Theirs = Callable[[Workshop, Scene, Sequence[Point]], Iterable[tuple[str, Picture, float, float]]]
"""Renders the points of the other side: name, picture, core-seconds, seconds before."""


def _by_mitsuba(
    workshop: Workshop, scene: Scene, points: Sequence[Point]
) -> Iterable[tuple[str, Picture, float, float]]:
    levels_spp = tuple(point.settings for point in points)
    found = workshop.call(render_levels, scene, workshop.effort.resolution, levels_spp, SEED)
    for point, level in zip(points, found.levels, strict=True):
        yield point.name, level.radiance_rgb, level.core_s, found.load_core_s


def _by_cycles(
    workshop: Workshop, scene: Scene, points: Sequence[Point]
) -> Iterable[tuple[str, Picture, float, float]]:
    from infra.bench.sides.cycles import Request, cycles_picture

    for point in points:
        request = Request(
            resolution=workshop.effort.resolution,
            spp=point.settings,
            denoise=True,
            threads=os.cpu_count() or 1,
        )
        picture = cycles_picture(scene, 0, request)
        yield point.name, picture.radiance_rgb, picture.core_s, picture.prepare_s


def beside(theirs: Theirs) -> Any:
    """Return the measuring of our targets beside another renderer's fixed numbers of samples."""

    def measure(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
        scene, px = workshop.scene(turn), workshop.effort.resolution
        camera, spp = first_camera(scene, px), 4 * workshop.effort.max_spp
        reference = workshop.call(raw_reference, scene, camera, spp)
        ours = {p.name: p.settings for p in points if isinstance(p.settings, RenderSettings)}
        taken = workshop.call(shots, scene, ours)
        others = [point for point in points if point.name not in ours]
        found: dict[str, dict[str, float]] = {}
        levels = []
        for point, made in zip(others, theirs(workshop, scene, others), strict=True):
            name, picture, core_s, load_s = made
            found[name] = {"core_s": core_s, "load_s": load_s, "spp": float(point.settings)}
            found[name] |= _errors(picture, reference)
            levels.append(PricedLevel(spp=point.settings, core_s=core_s, db=found[name]["db"]))
        for name, shot in taken.items():
            figures = _errors(shot.view.radiance_rgb, reference)
            stated = shot.view.noise_floor_db
            equal, has_it = at_error(levels, figures["db"])
            yield (
                name,
                {
                    **figures,
                    "core_s": shot.core_s,
                    "load_s": shot.load_core_s,
                    "spp": float(shot.view.spp),
                    "floor_db": stated,
                    "wrong": float(stated - figures["db"] > BROKEN_DB),
                    "times": equal.core_s / shot.core_s,
                    "bound": float(not has_it),
                },
            )
        yield from found.items()

    return measure


def _errors(picture: Picture, reference: Reference) -> dict[str, float]:
    everywhere = np.ones(picture.shape[:2], np.bool_)
    db, open_db = true_error_db(picture, reference, log10_radiance, everywhere)
    linear_db, _ = true_error_db(picture, reference, clamped_radiance, everywhere)
    return {"db": db, "linear_db": linear_db, "open_db": open_db}


_BESIDE = (
    Column(name="samples", figure="spp", over="mean"),
    Column(name="5th percentile dB", figure="db", over="p5"),
    WORST,
    Column(name="linear dB", figure="linear_db"),
    Column(name="stated floors wrong by over 1 dB, %", figure="wrong", over="mean", then=percent),
    Column(name="other side at equal error, times", figure="times"),
    Column(name="least times", figure="times", over="least"),
    Column(name="of them bounds, %", figure="bound", over="mean", then=percent),
    Column(name="what the reference leaves open, median dB", figure="open_db"),
)

EXPERIMENTS = (
    Experiment(
        name="frontier",
        title="Cost at equal error beside plain Mitsuba",
        about="Our stated floors beside Mitsuba's `path` integrator at fixed numbers of samples "
        "with one OIDN and our guide pictures, scene by scene in turns.",
        cost=CORE_S,
        error=DB,
        better="higher",
        against="raw samples of our tracer in two halves; median over the scenes",
        columns=_BESIDE,
        because="`other side at equal error` is the median over the scenes of Mitsuba's "
        "core-seconds, interpolated between its numbers of samples, divided by ours; where it "
        "cannot be interpolated it is a bound.",
        points=lambda effort: [*_ours(effort), *_mitsuba(effort)],
        turns=lambda effort: sampled_names(
            NUM_SAMPLED if effort.name == "careful" else effort.scenes
        ),
        takes_scenes=True,
        measure=beside(_by_mitsuba),
    ),
    Experiment(
        name="cycles",
        title="Cost at equal error beside Blender's Cycles",
        about="Our stated floors beside Cycles with OIDN at fixed numbers of samples, in a process "
        "of Blender's own; the first run installs Blender (GPL-3, 380 MB) in its own environment.",
        cost=CORE_S,
        error=DB,
        better="higher",
        against="raw samples of our tracer in two halves, which favours ours",
        columns=_BESIDE,
        points=lambda effort: [*_ours(effort), *_cycles(effort)],
        turns=lambda effort: sampled_names(min(6, effort.scenes)),
        takes_scenes=True,
        measure=beside(_by_cycles),
        needs=("blender",),
    ),
)
