"""What is traced and what is learned: cost against error of everything between the two."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from infra.bench.effort import Asked, Effort
from infra.bench.experiment import Column, Experiment, Point, TurnFigures
from infra.bench.experiments.engines import build_within
from infra.bench.experiments.sampling import DB
from infra.bench.sides.kept_references import kept_reference
from infra.bench.sides.rung_pictures import (
    Rung,
    judged,
    lamps_rung,
    network_rung,
    physics_alone,
    timed_rung,
    timed_samples,
)
from infra.bench.sides.sampled_pictures import first_camera
from infra.bench.sides.shots import SEED
from infra.bench.subjects.named_scenes import first_composed
from infra.bench.workshop import Workshop
from pipeline.builds.settings import BuildSettings
from pipeline.isolation import IsolatedChild
from pipeline.objects.generated import BENCHMARK
from pipeline.renders.settings import Filtered
from storage.dataset.splits import JUDGED_SPLIT
from storage.errors import Rejected
from storage.records.scene import Scene

LAMPS, PHYSICS = "direct light, no network", "all traced light, no network"
SHIPPED = ("builtin:", "builtin:tokens")
"""Networks that come along: the better one, and the one that traces nothing."""

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

KINDS = ("network", "traced light, no network", "path tracer, denoised")


class Means(NamedTuple):
    """What all turns share."""

    rungs: Mapping[str, Rung]
    """All that needs no render child, by name."""
    child: IsolatedChild
    """A render child of scenes that no network learned from."""
    build: BuildSettings
    """Its build."""


def network_name(label: str) -> str:
    """Return what the table calls a network."""
    return f"network {label}"


def network_points(asked: Asked) -> list[Point]:
    """Return the networks asked for, after those that come with Trilight."""
    others = [label for label in asked.network_names if label not in SHIPPED]
    return [Point(name=network_name(label)) for label in (*SHIPPED, *others)]


def rival(asked: Asked) -> str:
    """Return the first network that is asked for."""
    return network_name(asked.network_names[0])


def kind_of(name: str) -> str:
    """Return which of KINDS a point is."""
    if name.startswith("network"):
        return KINDS[0]
    return KINDS[1] if name in (LAMPS, PHYSICS) else KINDS[2]


def samples_name(wanted: tuple[int, Filtered]) -> str:
    """Return what the table calls so many samples with a filter."""
    return f"{wanted[0]} sample{'s' if wanted[0] > 1 else ''}, {wanted[1]}"


def means(workshop: Workshop, px: int) -> Means:
    """Return what rungs of a width need; made once."""
    return workshop.kept(("rungs", px), lambda: _set_up(workshop, px))


def one_view_scene(build: BuildSettings, index: int) -> Scene:
    """Return a scene with one camera, of objects that are judged on; runs in a render child."""
    settings = dataclasses.replace(build.scenes, num_views=1)
    scene, _ = first_composed(settings, index, seed=SEED, split=JUDGED_SPLIT)
    if scene is None:
        raise Rejected("no_scene", f"scene {index}: every attempt at it was rejected")
    return scene


def _points(effort: Effort) -> list[Point]:
    traced = [Point(name=name) for name in (LAMPS, PHYSICS)]
    return [*traced, *(Point(name=samples_name(one), settings=one) for one in SAMPLES)]


def _measure(workshop: Workshop, points: Sequence[Point], turn: str, *, px: int) -> TurnFigures:
    rungs, child, build = means(workshop, px)
    scene = child.call(one_view_scene, build, int(turn.split()[-1]))
    spp = 2 * workshop.effort.max_spp
    reference = kept_reference(child, scene, first_camera(scene, px), spp)
    for name, rung in rungs.items():
        yield name, judged(timed_rung(rung, scene), scene, reference)
    sampled = child.call(timed_samples, scene, px, SAMPLES)
    for wanted, picture in zip(SAMPLES, sampled, strict=True):
        yield samples_name(wanted), judged(picture, scene, reference)


def _set_up(workshop: Workshop, px: int) -> Means:
    import torch

    from model.neural_renderer import NeuralRenderer
    from train.loop.checkpoints import network_of_run

    torch.set_num_threads(1)  # core-seconds of waiting threads are not the network's
    rungs: dict[str, Rung] = {}
    places = dict(zip(workshop.asked.network_names, workshop.asked.checkpoint, strict=True))
    for label, place in (dict(zip(SHIPPED, SHIPPED, strict=True)) | places).items():
        renderer = NeuralRenderer.load(place, device="cpu", finders=[network_of_run])
        rungs[network_name(label)] = network_rung(renderer, px)
        workshop.note(f"{network_name(label)} is {renderer.digest[:8]}")
    workshop.note(f"differences are to {rival(workshop.asked)}")
    rungs |= {LAMPS: lamps_rung(px), PHYSICS: network_rung(physics_alone(), px)}
    build = build_within(TRIANGLES)
    return Means(rungs, workshop.render_child(build, BENCHMARK, threads=1), build)


def _experiment(px: int) -> Experiment:
    return Experiment(
        name=f"rungs-{px}",
        title=f"What is traced and what is learned, at {px} pixels",
        about=f"One view each of scenes of objects of `{BENCHMARK}`, which no network was trained "
        f"on, of at most {TRIANGLES} triangles; one thread, everything warm. The first of "
        "`--checkpoint` is what every row is compared with, view by view: the mean difference with "
        "its 95 % interval by scene.",
        cost=Column(name="a scene's first view, core-s", figure="core_s"),
        error=DB,
        better="higher",
        against="raw samples in two halves, so that neither their noise nor a denoiser is in it",
        columns=(
            Column(name="a further view, core-s", figure="view_s"),
            Column(name="5th percentile, dB", figure="db", over="p5"),
            Column(name="more than the first network, dB", figure="db", over="pair"),
            Column(name="object, dB", figure="object_db"),
            Column(name="linear, dB", figure="linear_db"),
            Column(name="SSIM", figure="ssim"),
        ),
        also_cost=("a further view, core-s",),
        because="A rung that is beaten at its price is no default: its card says so.",
        points=_points,
        asked_points=network_points,
        rival=rival,
        kind=kind_of,
        turns=lambda effort: [f"held-out {index}" for index in range(effort.scenes)],
        measure=functools.partial(_measure, px=px),
        needs=("torch",),
    )


EXPERIMENTS = (_experiment(64), _experiment(256))
