"""What is traced and what is learned: cost against error of everything between the two."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Point, TurnFigures
from infra.bench.experiments.engines import build_within
from infra.bench.experiments.sampling import DB
from infra.bench.sides.rung_pictures import judged, network_rung, physics_alone, sampled_rungs
from infra.bench.sides.shots import SEED
from infra.bench.subjects.named_scenes import first_composed
from infra.bench.workshop import Workshop
from pipeline.builds.settings import BuildSettings
from pipeline.objects.generated import BENCHMARK
from pipeline.renders.settings import Filtered
from storage.dataset.splits import JUDGED_SPLIT
from storage.errors import Rejected
from storage.records.scene import Scene

PHYSICS, SHIPPED, NETWORK = "traced light, nothing learned", "network builtin:", "network asked for"
SAMPLES: tuple[tuple[int, Filtered], ...] = (
    (1, "fast"),
    (1, "high"),
    (4, "fast"),
    (4, "high"),
    (16, "fast"),
    (16, "high"),
)
"""Samples a pixel, and the filter of Open Image Denoise."""

TRIANGLES = 768
"""Maximum number of triangles of a scene: what the small networks are trained on."""


def _points(effort: Effort) -> list[Point]:
    networks = [Point(name=name) for name in (SHIPPED, NETWORK, PHYSICS)]
    return [*networks, *(Point(name=_name(one), settings=one) for one in SAMPLES)]


def _name(wanted: tuple[int, Filtered]) -> str:
    return f"{wanted[0]} samples, {wanted[1]}" if wanted[0] > 1 else f"1 sample, {wanted[1]}"


def _measure(workshop: Workshop, points: Sequence[Point], turn: str, *, px: int) -> TurnFigures:
    networks, child, build = workshop.kept("rungs", lambda: _set_up(workshop))
    index = int(turn.split()[-1])
    scene = child.call(one_view_scene, build, index)
    sampled, reference = child.call(sampled_rungs, scene, px, SAMPLES, 2 * workshop.effort.max_spp)
    for name, renderer in networks.items():
        yield name, judged(network_rung(renderer, scene, px), scene, reference)
    for wanted, picture in zip(SAMPLES, sampled, strict=True):
        yield _name(wanted), judged(picture, scene, reference)


def one_view_scene(build: BuildSettings, index: int) -> Scene:
    """Return a scene with one camera, of objects that are judged on; runs in a render child."""
    settings = dataclasses.replace(build.scenes, num_views=1)
    scene, _ = first_composed(settings, index, seed=SEED, split=JUDGED_SPLIT)
    if scene is None:
        raise Rejected("no_scene", f"scene {index}: every attempt at it was rejected")
    return scene


def _set_up(workshop: Workshop) -> Any:
    """Return the networks, a render child of scenes that none of them learned from, its build."""
    import torch

    from model.neural_renderer import NeuralRenderer
    from train.loop.checkpoints import network_of_run

    torch.set_num_threads(1)  # core-seconds of waiting threads are not the network's
    asked = workshop.asked.checkpoint
    networks = {PHYSICS: physics_alone()}
    for name, place in ((SHIPPED, "builtin:"), (NETWORK, asked)):
        renderer = NeuralRenderer.load(place, device="cpu", finders=[network_of_run])
        networks[name] = renderer
        workshop.note(f"{name} is {Path(place).name}, {renderer.digest[:8]}")
    build = build_within(TRIANGLES)
    return networks, workshop.render_child(build, BENCHMARK, threads=1), build


def _experiment(px: int) -> Experiment:
    return Experiment(
        name=f"rungs-{px}",
        title=f"What is traced and what is learned, at {px} pixels",
        about=f"One view each of scenes of objects of `{BENCHMARK}`, which no network was trained "
        f"on, of at most {TRIANGLES} triangles; one thread, everything warm.",
        cost=Column(name="core-seconds of a scene's first view", figure="core_s"),
        error=DB,
        better="higher",
        against="raw samples in two halves, so that neither their noise nor a denoiser is in it",
        columns=(
            Column(name="a further view, core-s", figure="view_s"),
            Column(name="5th percentile, dB", figure="db", over="p5"),
            Column(name="mean, dB", figure="db", over="mean"),
            Column(name="mean, low", figure="db", over="low"),
            Column(name="mean, high", figure="db", over="high"),
            Column(name="object, dB", figure="object_db"),
            Column(name="linear, dB", figure="linear_db"),
            Column(name="SSIM", figure="ssim"),
        ),
        also_cost=("a further view, core-s",),
        because="A rung that is beaten at its price is no default: its card says so.",
        points=_points,
        turns=lambda effort: [f"held-out {index}" for index in range(effort.scenes)],
        measure=functools.partial(_measure, px=px),
        needs=("torch",),
    )


EXPERIMENTS = (_experiment(64), _experiment(256))
