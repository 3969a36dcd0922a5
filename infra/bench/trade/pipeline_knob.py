"""What a thousand training views take, from objects at hand to packed samples."""

import contextlib
import dataclasses
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from infra.bench.cycles.child import sampled_scene
from infra.bench.render_child import asked_child
from infra.bench.renders.ladder import warm_up_denoiser, warm_up_kernels
from infra.bench.samples import first_sample
from infra.bench.trade.curves import Curve, Knob, Point
from infra.bench.trade.workshop import Workshop
from pipeline.flows.settings import BuildSettings
from pipeline.flows.training_builds import pretrain_256
from pipeline.renders.settings import RenderSettings
from storage.changes import changed
from storage.sample import encode_sample

TARGETS_DB = (38.0, 42.0, 46.0)


@dataclass(frozen=True, kw_only=True)
class SetFigures:
    """One sample, from settings to bytes."""

    core_s: float
    """Composing, rejected attempts, rendering, packing."""
    num_bytes: int
    """Of all members."""
    floors_db: tuple[float, ...]
    """What its views state."""


def packed_sample(build: BuildSettings, scene_index: int) -> SetFigures:
    """Make one sample of a build, attempt after attempt; runs in a render child of it."""
    started = time.process_time()
    sample = first_sample(scene_index)
    members = encode_sample(sample, build.storage.profile)
    return SetFigures(
        core_s=time.process_time() - started,
        num_bytes=sum(len(data) for data in members.values()),
        floors_db=tuple(view.noise_floor_db for view in sample.views),
    )


def measure_pipeline(shop: Workshop) -> Curve:
    """Measure a few scenes of a set at each floor."""
    effort, points = shop.effort, []
    most = 2 * effort.max_spp  # else the higher targets all end at the cap
    common = {
        "scenes.num_views": 2,
        "renders.resolution": effort.picture_px,
        "renders.max_spp": most,
    }
    for target_db in TARGETS_DB:
        build = changed(pretrain_256(), {**common, "renders.noise_floor_db": target_db})
        made = _made(build, shop)
        floors = [floor for one in made for floor in one.floors_db]
        core_h = sum(one.core_s for one in made) / len(floors) / 3.6
        points.append(
            Point(
                setting=f"{target_db:.0f} dB",
                cost=core_h,
                error=float(np.median(floors)),
                default=target_db == pretrain_256().renders.noise_floor_db,
                further={
                    "5th percentile dB": float(np.percentile(floors, 5)),
                    "views at the target %": 100 * float(np.mean(np.array(floors) >= target_db)),
                    "MB": sum(one.num_bytes for one in made) / len(floors) / 1000,
                },
            )
        )
    px = effort.picture_px
    words = f"{effort.scenes} scenes of `pretrain-256` with two views of {px} x {px}, at most"
    return Curve(points=tuple(points), measured_on=f"{words} {most} samples")


def _made(build: BuildSettings, shop: Workshop) -> list[SetFigures]:
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        child = asked_child(folder, build, shop.options)
        stack.enter_context(contextlib.closing(child))
        child.call(warm_up, build.renders)
        return [child.call(packed_sample, build, index) for index in range(shop.effort.scenes)]


def warm_up(renders: RenderSettings) -> None:
    """Compile the kernels, in a render child: a run does it once for hundreds of scenes."""
    warm_up_kernels(sampled_scene(0), dataclasses.replace(renders, min_mean_radiance=0.0))
    warm_up_denoiser(renders.resolution)


KNOBS = (
    Knob(
        name="pipeline",
        title="A thousand training views",
        covers=("build.build", "order.build"),
        cost="core-hours of 1000 views: composing, rendering, packing",
        error="median of the views' stated floors, dB",
        better="higher",
        against="each view's own measured noise floor (psnr_log_db; on held-out scenes 8 % of the "
        "stated floors are more than 1 dB better than the truth)",
        because="46 dB and a cap of 4096 samples in the training builds. Objects are prepared once "
        "for every set (seconds each) and not counted.",
        measure=measure_pipeline,
    ),
)
