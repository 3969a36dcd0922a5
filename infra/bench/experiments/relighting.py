"""Experiment `relighting`: stated errors of single lights, and the true error of relit pictures.

Scenes are those of the preset `olat`, and the gains of each light and channel are random.
The reference of each light is raw samples of that light alone in two independent halves. Relit
pictures and their references are sums of the same lights with the same gains.
"""

import dataclasses
from functools import partial

import numpy as np
from numpy.typing import NDArray

from infra.bench.context import BenchContext
from infra.bench.experiment import BenchScale, Column, Experiment, Figures, Point, percent
from infra.bench.workloads.named_scenes import preset_scene
from infra.bench.workloads.traced_pictures import render_shot
from infra.bench_options import BenchOptions
from infra.render.raw_references import (
    RawReference,
    first_camera,
    light_references,
    true_error_db,
)
from pipeline.presets.training import olat
from storage.conventions import log10_radiance
from storage.seeds import rng_for

TARGETS_DB = (38.0, 42.0, 46.0)

MOST_GAIN = 4.0
"""Gains of each light and channel are log-uniform between its inverse and it."""

_ALLOWED_DB = 1.0
"""A stated error that is better than the true one by more is a miss."""


def _points(scale: BenchScale, options: BenchOptions) -> list[Point]:
    default_db = olat().renders.noise_floor_db
    return [
        Point(
            name=f"{target_db:.0f} dB",
            measure=partial(_measure, target_db),
            default=target_db == default_db,
        )
        for target_db in TARGETS_DB
    ]


def _measure(target_db: float, context: BenchContext, trial: str) -> Figures:
    index = int(trial.split()[-1])
    px = context.scale.resolution
    spp = 4 * context.scale.reference_spp
    scene = context.get_or_make(trial, lambda: preset_scene(context.child, olat(), index))
    references = context.get_or_make(
        (trial, "lights"),
        lambda: context.child.call(light_references, scene, first_camera(scene, px), spp),
    )
    settings = dataclasses.replace(olat().renders, resolution=px, noise_floor_db=target_db)
    view = context.child.call(render_shot, scene, settings)
    assert view.light_floors is not None and view.lights_rgb is not None

    def error_db(picture: NDArray[np.float32], reference: RawReference) -> float:
        return true_error_db(picture, reference, log10_radiance)[0]

    gains = MOST_GAIN ** rng_for(index, "gains").uniform(-1, 1, (len(references), 1, 1, 3))
    of_relit = (gains[:, None] * references).sum(axis=0)
    lights = zip(view.light_floors, view.lights_rgb, references, strict=True)
    excess = np.array([floor.noise_floor_db - error_db(light, raw) for floor, light, raw in lights])
    relit = (gains * view.lights_rgb).sum(axis=0).astype(np.float32)
    return {
        "core_s": view.core_s,
        "lights": len(references),
        "relit_db": error_db(relit, of_relit),
        "stated_db": view.noise_floor_db,
        "true_db": error_db(view.radiance_rgb, references.sum(axis=0)),
        "missed": float((excess > _ALLOWED_DB).mean()),
        "excess_db": float(excess.max()),
        "caution_db": float(np.median(-excess)),
    }


EXPERIMENT = Experiment(
    name="relighting",
    title="Scenes with one light at a time: stated errors of lights, true errors of relit pictures",
    cost=Column("core-seconds a view", "core_s"),
    error=Column("relit, true error, dB", "relit_db"),
    better="higher",
    columns=(
        Column("relit, least, dB", "relit_db", over="least"),
        Column("stated of the picture, dB", "stated_db"),
        Column("true of the picture, dB", "true_db"),
        Column("lights, mean", "lights", over="mean"),
        Column("lights over 1 dB worse than stated, %", "missed", over="mean", then=percent),
        Column("worst light beyond its stated error, dB", "excess_db", over="most"),
        Column("caution of stated errors of lights, dB", "caution_db"),
    ),
    because="A relit picture is as good as its lights: gains below 1 hide errors in log light, and "
    "gains above 1 show them.",
    points=_points,
    trials=lambda scale, options: [f"scene {index}" for index in range(scale.scenes)],
)
