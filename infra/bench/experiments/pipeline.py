"""What a thousand training views take, from objects at hand to packed samples."""

import dataclasses
import time

import numpy as np

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Figures, Point, one_by_one, percent
from infra.bench.sides.shots import warm_up_denoiser, warm_up_kernels
from infra.bench.subjects.named_scenes import first_sample, sampled_scene
from infra.bench.workshop import Workshop
from pipeline.builds.settings import BuildSettings
from pipeline.builds.training import pretrain_256
from pipeline.isolation import IsolatedChild
from pipeline.renders.settings import RenderSettings
from storage.records.sample import encode_sample
from storage.settings.changes import changed

TARGETS_DB = (38.0, 42.0, 46.0)
VIEWS = 2


def packed_sample(build: BuildSettings, scene_index: int) -> dict[str, float]:
    """Make one sample of a build, attempt after attempt; runs in a render child of it."""
    started = time.process_time()
    sample = first_sample(scene_index)
    members = encode_sample(sample, build.storage.profile)
    core_s = time.process_time() - started
    floors = [view.noise_floor_db for view in sample.views]
    return {
        "core_h": core_s / VIEWS / 3.6,
        "floor_db": float(np.median(floors)),
        "least_db": min(floors),
        "reached": float(np.mean(np.array(floors) >= build.renders.noise_floor_db)),
        "mb": sum(len(data) for data in members.values()) / VIEWS / 1000,
    }


def warm_up(renders: RenderSettings) -> None:
    """Compile the kernels, in a render child: a run does it once for hundreds of scenes."""
    warm_up_kernels(sampled_scene(0), dataclasses.replace(renders, min_mean_radiance=0.0))
    warm_up_denoiser(renders.resolution)


def _builds(effort: Effort) -> list[Point]:
    common = {
        "scenes.num_views": VIEWS,
        "renders.resolution": effort.picture_px,
        "renders.max_spp": 2 * effort.max_spp,  # else the higher targets all end at the cap
    }
    return [
        Point(
            name=f"{target_db:.0f} dB",
            settings=changed(pretrain_256(), {**common, "renders.noise_floor_db": target_db}),
            default=target_db == pretrain_256().renders.noise_floor_db,
        )
        for target_db in TARGETS_DB
    ]


def _measure(workshop: Workshop, point: Point, turn: str) -> Figures:
    def warm() -> IsolatedChild:
        child = workshop.child_of(point.settings)
        child.call(warm_up, point.settings.renders)
        return child

    return workshop.kept(point.name, warm).call(
        packed_sample, point.settings, int(turn.split()[-1])
    )


EXPERIMENTS = (
    Experiment(
        name="pipeline",
        title="A thousand training views",
        about="Scenes of `pretrain-256` with two views each: composing, rejected attempts, "
        "rendering, packing.",
        covers=("build.build", "order.build"),
        cost=Column(
            name="core-hours of 1000 views: composing, rendering, packing",
            figure="core_h",
            over="mean",
        ),
        error=Column(name="median of the views' stated floors, dB", figure="floor_db"),
        better="higher",
        against="each view's own measured noise floor (psnr_log_db; on held-out scenes 8 % of the "
        "stated floors are more than 1 dB better than the truth)",
        columns=(
            Column(name="5th percentile dB", figure="least_db", over="p5"),
            Column(
                name="views at the target %",
                figure="reached",
                over="mean",
                then=percent,
            ),
            Column(name="MB", figure="mb", over="mean"),
        ),
        because="Default: 46 dB and a cap of 4096 samples in the training builds. Objects are "
        "prepared once for every set (seconds each) and not counted.",
        points=_builds,
        turns=lambda effort: [f"scene {index}" for index in range(effort.scenes)],
        measure=one_by_one(_measure),
    ),
)
