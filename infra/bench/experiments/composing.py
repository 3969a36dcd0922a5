"""Scenes per second and core by build, beside what rendering them takes.

One process and one thread. Composing counts attempts that were rejected; rendering is that of
`smoke`, the cheapest build that there is, so that the share of composing is the largest.
"""

import time

import numpy as np

from infra.bench.experiment import Column, Experiment, Figures, Point, one_by_one, repeats
from infra.bench.subjects.named_scenes import first_composed, first_sample
from infra.bench.workshop import Workshop
from pipeline.builds.named import BUILDS
from pipeline.builds.training import smoke

COMPOSED = (
    "pretrain-256",
    "finetune-512",
    "renderformer-v1-256",
    "renderformer-v1-512",
    "out-of-range",
)
RENDERED = "smoke, composed and rendered"
_RENDERED_SCENES = 4


def composed(build: str, count: int) -> dict[str, float]:
    """Compose scenes in a render child, each until an attempt passes."""
    settings = BUILDS[build].settings().scenes
    triangles, rejected = [], 0
    began = time.process_time()
    for scene_index in range(count):
        scene, attempts = first_composed(settings, scene_index)
        rejected += attempts
        if scene is not None:
            triangles.append(scene.num_triangles)
    core_s = time.process_time() - began
    return {
        "core_s": core_s / len(triangles),
        "rejected": float(rejected),
        "triangles": float(np.mean(triangles)),
    }


def rendered(count: int) -> dict[str, float]:
    """Compose and render scenes in a render child."""
    began = time.process_time()
    samples = [first_sample(index) for index in range(count)]
    core_s = (time.process_time() - began) / count
    return {
        "core_s": core_s,
        "triangles": float(np.mean([one.scene.num_triangles for one in samples])),
    }


def _measure(workshop: Workshop, point: Point, turn: str) -> Figures:
    child = workshop.kept(
        "one thread", lambda: workshop.render_child(smoke(), workshop.asked.objects[0], threads=1)
    )
    if point.name == RENDERED:
        return child.call(rendered, _RENDERED_SCENES)
    return child.call(composed, point.name, workshop.effort.composed)


EXPERIMENTS = (
    Experiment(
        name="composing",
        title="Composing scenes beside rendering them",
        about=(
            "Composing a scene in one thread; for comparison, the last row renders four views "
            "of a scene with the cheapest build."
        ),
        cost=Column(name="core-seconds a scene", figure="core_s"),
        columns=(
            Column(name="scenes a second", figure="core_s", then=lambda s: 1 / s),
            Column(name="triangles", figure="triangles"),
            Column(name="rejected attempts", figure="rejected"),
        ),
        points=lambda effort: [Point(name=name) for name in (*COMPOSED, RENDERED)],
        turns=repeats,
        measure=one_by_one(_measure),
        warm_up=True,
    ),
)
