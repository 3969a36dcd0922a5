"""What is stored of a scene: how large pictures are, of how many cameras, and of which lights."""

import dataclasses
import time
from collections.abc import Sequence

import numpy as np

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Point, TurnFigures
from infra.bench.experiments.sampling import CORE_S, DB, measure, scenes
from infra.bench.sides.shots import fixed_samples, shots
from infra.bench.subjects.named_scenes import sampled_names, sampled_scene
from infra.bench.workshop import Workshop
from pipeline.builds.training import pretrain_256, smoke
from pipeline.renders.renderer import SceneRenderer
from storage.metrics import psnr_log_db

VIEWS = (1, 2, 4, 8, 16)


def _measure_resolution(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    """Compare with the largest picture, of which a smaller one keeps means of blocks of pixels."""
    from train.data.resolution import block_mean

    variants = {point.name: point.settings for point in points}
    taken = workshop.call(shots, workshop.subject(turn).scene, variants)
    whole = taken[points[-1].name].view.radiance_rgb
    for point in points:
        shot, px = taken[point.name], point.settings.resolution
        kept = block_mean(whole[None], px)[0]
        again = kept.repeat(len(whole) // px, 0).repeat(len(whole) // px, 1)
        yield (
            point.name,
            {
                "core_s": shot.core_s,
                "db": psnr_log_db(again, whole),
                "spp": float(shot.view.spp),
                "kb": shot.packed_bytes / 1000,
            },
        )


def _widths(effort: Effort) -> list[Point]:
    base = dataclasses.replace(
        pretrain_256().renders,
        noise_floor_db=smoke().renders.noise_floor_db,
        max_spp=effort.max_spp,
        min_mean_radiance=0.0,
    )
    return [
        Point(
            name=f"{px} x {px}",
            settings=dataclasses.replace(base, resolution=px),
            default=px == effort.widths[2],
        )
        for px in effort.widths
    ]


def _lights(effort: Effort) -> list[Point]:
    together = fixed_samples(effort.resolution, 64)
    apart = dataclasses.replace(together, per_light=True)
    return [
        Point(name="one picture", settings=together, default=True),
        Point(name="one picture of each light", settings=apart),
    ]


def scene_parts(scene_index: int, resolution: int) -> dict[str, float]:
    """Return core-seconds of composing a scene, loading it, and one view; in a render child."""
    settings = dataclasses.replace(smoke().renders, resolution=resolution, min_mean_radiance=0.0)
    marks = [time.process_time()]
    scene = sampled_scene(scene_index)
    marks.append(time.process_time())
    renderer = SceneRenderer(scene, settings)
    marks.append(time.process_time())
    renderer.render_view(scene.c2w[0], float(scene.fov_deg[0]), 0)
    marks.append(time.process_time())
    spent = np.diff(marks)
    return dict(zip(("compose_s", "load_s", "view_s"), map(float, spent), strict=True))


def _measure_views(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    """Measure what is shared among the views of a scene, and share it out."""
    px = workshop.effort.picture_px
    workshop.kept("compiled", lambda: workshop.call(scene_parts, 0, px))
    found = workshop.call(scene_parts, int(turn.split()[-1]), px)
    shared = found["compose_s"] + found["load_s"]
    for point in points:
        views = point.settings
        share = 100 * shared / (shared + views * found["view_s"])
        yield (
            point.name,
            {"core_s": found["view_s"] + shared / views, "kinds": 1000 / views, "share": share},
        )


EXPERIMENTS = (
    Experiment(
        name="resolution",
        title="Resolution",
        about="Views of a few scenes at several widths, sampled to the noise floor of `smoke`.",
        covers=(
            "build.renders.resolution",
            "order.resolution",
            "render.resolution",
            "train.resolution",
        ),
        cost=CORE_S,
        error=DB,
        better="higher",
        against="the largest picture, of which the smaller one keeps the means of blocks of "
        "pixels; median over the scenes. The largest is exact by definition (100 dB)",
        columns=(
            Column(name="samples", figure="spp", over="mean"),
            Column(name="kB", figure="kb", over="mean"),
        ),
        because=(
            "Default: the published stages, 256 and then 512. Pixels are box averages, so a "
            "smaller picture can always be made from a larger one, and never the other way "
            "round."
        ),
        points=_widths,
        turns=lambda effort: sampled_names(max(2, effort.scenes // 3)),
        measure=_measure_resolution,
    ),
    Experiment(
        name="lights",
        title="A picture of each light",
        about="Scenes of several lights at 64 samples, together and light by light.",
        covers=("build.renders.per_light", "train.augmentation.light_mix"),
        cost=CORE_S,
        error=DB,
        better="higher",
        against="a converged reference of other samples, of the sum of the lights; median over the "
        "scenes",
        columns=(Column(name="kB", figure="kb", over="mean"),),
        also_cost=("kB",),
        because=(
            "Default: off, since it costs as many pictures as there are lights. Turn it on for "
            "a training that mixes lights anew at every visit (`light_mix`), which is exact "
            "and otherwise impossible."
        ),
        points=_lights,
        turns=lambda effort: scenes(effort)[:4],
        measure=measure,
    ),
    Experiment(
        name="views",
        title="Views of each scene",
        about=(
            "Cost of composing, loading and rendering scenes of `smoke`, divided by their "
            "number of views."
        ),
        covers=("build.scenes.num_views", "order.views", "train.views_per_scene"),
        cost=Column(name="core-seconds a view, with its share", figure="core_s", over="mean"),
        error=Column(name="different scenes in 1000 views", figure="kinds"),
        better="higher",
        against="nothing: what is lost is variety, which only training can weigh",
        columns=(Column(name="share of scene %", figure="share", over="mean"),),
        because=(
            "Default: 4. Composing and loading are so small a share of a view's cost that more "
            "views save hardly anything; four let a training step see a scene from several "
            "sides after encoding it once."
        ),
        points=lambda effort: [
            Point(name=f"{views}", settings=views, default=views == smoke().scenes.num_views)
            for views in VIEWS
        ],
        turns=lambda effort: [f"sampled {index}" for index in range(effort.scenes)],
        measure=_measure_views,
    ),
)
