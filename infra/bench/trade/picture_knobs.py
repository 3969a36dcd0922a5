"""What is stored of a scene: how large pictures are, of how many cameras, and of which lights."""

import dataclasses
import time

import numpy as np

from infra.bench.renders.fixed_samples import fixed_samples
from infra.bench.trade.curves import Curve, Knob, Point
from infra.bench.trade.render_knobs import to_reference
from infra.bench.trade.rendered import shots
from infra.bench.trade.workshop import Workshop
from pipeline.flows.training_builds import pretrain_256, smoke
from storage.metrics import psnr_log_db
from storage.scene import Scene

VIEWS = (1, 2, 4, 8, 16)


def measure_resolution(shop: Workshop) -> Curve:
    """Measure pictures of one floor at several widths; each pixel of a small one is repeated."""
    from train.data.resolution import block_mean

    effort, base = shop.effort, pretrain_256().renders
    widths = effort.widths
    variants = {
        f"{px} x {px}": dataclasses.replace(
            base,
            resolution=px,
            noise_floor_db=smoke().renders.noise_floor_db,
            max_spp=effort.max_spp,
            min_mean_radiance=0.0,
        )
        for px in widths
    }
    subjects = shop.subjects[: max(2, effort.scenes // 3)]
    taken = [shop.call(shots, subject.scene, variants) for subject in subjects]
    largest = widths[-1]
    whole = [of_scene[f"{largest} x {largest}"].view.radiance_rgb for of_scene in taken]
    found = []
    for px in widths:
        mine = [of_scene[f"{px} x {px}"] for of_scene in taken]
        kept = [block_mean(picture[None], px)[0] for picture in whole]
        again = [picture.repeat(largest // px, 0).repeat(largest // px, 1) for picture in kept]
        errors = [psnr_log_db(a, b) for a, b in zip(again, whole, strict=True)]
        found.append(
            Point(
                setting=f"{px} x {px}",
                cost=float(np.mean([shot.core_s for shot in mine])),
                error=float(np.median(errors)),
                default=px == widths[2],
                further={
                    "samples": float(np.mean([shot.view.spp for shot in mine])),
                    "kB": float(np.mean([shot.packed_bytes for shot in mine])) / 1000,
                },
            )
        )
    words = f"{len(subjects)} scenes, one view each, to {smoke().renders.noise_floor_db:.0f} dB"
    return Curve(points=tuple(found), measured_on=f"{words} or {effort.max_spp} samples")


def measure_lights(shop: Workshop) -> Curve:
    """Measure one picture against one of every light."""
    together = fixed_samples(shop.effort.resolution, 64)
    variants = {
        "one picture": together,
        "one picture of each light": dataclasses.replace(together, per_light=True),
    }
    found = []
    subjects = shop.subjects[:4]
    taken = [(subject, shop.call(shots, subject.scene, variants)) for subject in subjects]
    lights = [sum(entry.kind == "emitter" for entry in s.scene.objects) for s in subjects]
    for name, settings in variants.items():
        mine = [(subject, of_scene[name]) for subject, of_scene in taken]
        found.append(
            Point(
                setting=name,
                cost=float(np.mean([shot.core_s for _, shot in mine])),
                error=float(np.median([to_reference(*pair) for pair in mine])),
                default=not settings.per_light,
                further={"kB": float(np.mean([shot.packed_bytes for _, shot in mine])) / 1000},
            )
        )
    words = f"{len(subjects)} scenes with {np.mean(lights):.1f} lights on average, 64 samples"
    return Curve(points=tuple(found), measured_on=f"{words}, of each light where they are apart")


def scene_parts(scene_index: int, resolution: int) -> dict[str, float]:
    """Return core-seconds of composing a scene, loading it, and one view; in a render child."""
    from infra.bench.cycles.child import sampled_scene
    from pipeline.renders.renderer import SceneRenderer

    settings = dataclasses.replace(smoke().renders, resolution=resolution, min_mean_radiance=0.0)
    marks = [time.process_time()]
    scene: Scene = sampled_scene(scene_index)
    marks.append(time.process_time())
    renderer = SceneRenderer(scene, settings)
    marks.append(time.process_time())
    renderer.render_view(scene.c2w[0], float(scene.fov_deg[0]), 0)
    marks.append(time.process_time())
    spent = np.diff(marks)
    return dict(zip(("compose_s", "load_s", "view_s"), map(float, spent), strict=True))


def measure_views(shop: Workshop) -> Curve:
    """Measure what is shared among the views of a scene, and share it out."""
    px = shop.effort.picture_px
    shop.call(scene_parts, 0, px)  # compiles
    rows = [shop.call(scene_parts, scene, px) for scene in range(shop.effort.scenes)]
    mean = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    shared = mean["compose_s"] + mean["load_s"]
    found = [
        Point(
            setting=f"{views}",
            cost=mean["view_s"] + shared / views,
            error=1000 / views,
            default=views == smoke().scenes.num_views,
            further={"share of scene %": 100 * shared / (shared + views * mean["view_s"])},
        )
        for views in VIEWS
    ]
    words = f"{len(rows)} scenes of `smoke`, views of {px} x {px} to its floor"
    return Curve(points=tuple(found), measured_on=words)


KNOBS = (
    Knob(
        name="resolution",
        title="Resolution",
        covers=(
            "build.renders.resolution",
            "order.resolution",
            "render.resolution",
            "train.resolution",
        ),
        cost="core-seconds a view",
        error="psnr_log_db, dB",
        better="higher",
        against="the largest picture, of which the smaller one keeps the means of blocks of "
        "pixels; median over the scenes. The largest is exact by definition (100 dB)",
        because="the published stages, 256 and then 512. Pictures are box averages, so a smaller "
        "one can always be had from a larger one, and never the other way round.",
        measure=measure_resolution,
    ),
    Knob(
        name="lights",
        title="A picture of each light",
        covers=("build.renders.per_light", "train.augmentation.light_mix"),
        cost="core-seconds a view",
        error="psnr_log_db, dB",
        better="higher",
        against="a converged reference of other samples, of the sum of the lights; median over the "
        "scenes",
        also_cost=("kB",),
        because="off: it costs as many pictures as there are lights. On where training is to mix "
        "lights anew at every visit (`light_mix`), which is exact and otherwise impossible.",
        measure=measure_lights,
    ),
    Knob(
        name="views",
        title="Views of each scene",
        covers=("build.scenes.num_views", "order.views", "train.views_per_scene"),
        cost="core-seconds a view, with its share of composing and loading the scene",
        error="different scenes in 1000 views",
        better="higher",
        against="nothing: it is variety that is lost, which only training can weigh",
        because="4: composing and loading are so small a share of a view that more views save "
        "hardly anything; four let a step see a scene from several sides after encoding it once.",
        measure=measure_views,
    ),
)
