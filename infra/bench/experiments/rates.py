"""Rates of rendering: views per core-hour, and what a path costs."""

import dataclasses
import time
from collections.abc import Mapping, Sequence

from infra.bench.experiment import (
    Column,
    Experiment,
    Point,
    TurnFigures,
    one_by_one,
    percent,
    repeats,
)
from infra.bench.experiments.beside import TARGETS_DB, adaptive
from infra.bench.experiments.sampling import CORE_S
from infra.bench.sides.sampled_pictures import first_camera
from infra.bench.sides.shots import SEED, shots
from infra.bench.subjects.cost_scene import cost_scene
from infra.bench.subjects.named_scenes import sampled, sampled_names
from infra.bench.workshop import Workshop
from pipeline.making.price import USD_PER_CORE_HOUR
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.settings import PASS_SPP, RenderSettings

MANY_VIEWS = 8_000_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class PathCost:
    """One value of every axis; the defaults are what stays fixed on the others."""

    triangles: int = 1000
    """Triangles of the scene, about."""
    lights: int = 4
    """Emitting triangles."""
    depth: int = RenderSettings.max_depth
    """Longest path in edges."""
    resolution: int = 256
    """Pixels each way."""


AXES: Mapping[str, tuple[int, ...]] = {
    "triangles": (100, 316, 1000, 3162, 10_000, 31_623),
    "lights": (1, 2, 4, 8, 16, 32),
    "depth": (2, 3, 4, 6, 8, 12, 16),
    "resolution": (64, 128, 256, 512),
}


def traced(settings: PathCost) -> dict[str, float]:
    """Load the scene and trace one pass, without the denoiser, in a render child."""
    scene = cost_scene(settings.triangles, settings.lights)
    camera = first_camera(scene, settings.resolution)
    started = time.process_time()
    tracer = load_tracer(scene, max_depth=settings.depth, rr_depth=RenderSettings.rr_depth)
    loaded = time.process_time()
    tracer.radiance(camera, seed=SEED, spp=PASS_SPP[0])
    core_s = time.process_time() - loaded
    megapaths = settings.resolution**2 * PASS_SPP[0] / 1e6
    return {"core_s": core_s / megapaths, "load_s": loaded - started}


def _measure_throughput(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    scene = sampled(int(turn.split()[-1])).make(workshop.child)
    taken = workshop.call(shots, scene, {point.name: point.settings for point in points})
    for name, shot in taken.items():
        yield (
            name,
            {
                "core_s": shot.core_s,
                "load_s": shot.load_core_s,
                "floor_db": shot.view.noise_floor_db,
                "reached": float(not shot.view.at_cap),
                "spp": float(shot.view.spp),
            },
        )


EXPERIMENTS = (
    Experiment(
        name="throughput",
        title="Views per core-hour by noise floor",
        about="One view of each scene at 256 and 512 pixels; scenes are loaded, kernels warm.",
        cost=CORE_S,
        columns=(
            Column(
                name="views per core-hour", figure="core_s", over="mean", then=lambda s: 3600 / s
            ),
            Column(name="reached it, %", figure="reached", over="mean", then=percent),
            Column(name="median floor dB", figure="floor_db"),
            Column(name="samples", figure="spp", over="mean"),
            Column(
                name=f"USD for {MANY_VIEWS // 1_000_000} million views at {USD_PER_CORE_HOUR} a "
                "core-hour",
                figure="core_s",
                over="mean",
                then=lambda s: MANY_VIEWS * s / 3600 * USD_PER_CORE_HOUR,
            ),
            Column(name="loading a scene, core-seconds", figure="load_s", over="mean"),
        ),
        points=lambda effort: [
            Point(
                name=f"{px} x {px} to {target_db:.0f} dB",
                settings=adaptive(target_db, px, effort.max_spp),
            )
            for px in (2 * effort.resolution, 4 * effort.resolution)
            for target_db in TARGETS_DB
        ],
        turns=lambda effort: sampled_names(effort.scenes),
        measure=_measure_throughput,
    ),
    Experiment(
        name="path-cost",
        title="What a million camera paths cost",
        about=(
            "Tracing alone, of two objects in a room, varied along one axis at a time: the "
            "product's passes with their quarter of light paths, without a denoiser."
        ),
        cost=Column(name="core-seconds per million paths", figure="core_s"),
        columns=(Column(name="loading, core-seconds", figure="load_s"),),
        points=lambda effort: [
            Point(name=f"{axis} {value}", settings=dataclasses.replace(PathCost(), **{axis: value}))
            for axis, values in AXES.items()
            for value in values
        ],
        turns=repeats,
        measure=one_by_one(lambda workshop, point, turn: workshop.call(traced, point.settings)),
        warm_up=True,
    ),
)
