"""Experiment `cycles`: Trilight's pictures compared with raw ones of Blender's Cycles.

Scenes are sampled ones, such with procedural surfaces, such below skies, objects alone, and those
of `--scenes`. The first run installs Blender (GPL-3, 380 MB) in an environment of its own.
"""

import dataclasses
from functools import partial

import numpy as np
from numpy.typing import NDArray

from infra.bench.context import BenchContext
from infra.bench.experiment import BenchScale, Column, Experiment, Figures, Point, percent
from infra.bench.experiments.frontier import adaptive_settings
from infra.bench.workloads.cycles import render_with_cycles
from infra.bench.workloads.named_scenes import given_scenes, preset_scene
from infra.bench.workloads.traced_pictures import (
    difference_db,
    render_shot,
    render_shots,
    shrink_reference,
)
from infra.bench_options import BenchOptions
from infra.render.raw_references import RawReference, first_camera, raw_reference, true_error_db
from pipeline.generation.scene_worker import SceneWorker
from pipeline.presets.training import object_views, textured_256
from pipeline.renders.noise_floor import clamped_radiance
from pipeline.renders.settings import USUAL_FLOOR_DB
from pipeline.renders.tracer import pixel_camera
from scene_templates.settings import SceneSettings
from storage.conventions import log10_radiance
from storage.metrics import psnr_linear_db
from storage.records.scene import Scene
from storage.settings.overrides import apply_overrides

PLAIN = "plain"
TEXTURED = "textured"
SKY = "sky"
GIVEN = "given"
OBJECT = "object"
RESOLUTION = 64
OUR_SHARE = 4
"""Samples of Trilight, in two halves, for each sample of Cycles, since they cost less."""

EXPOSED = 0.5
"""Radiance of the 90th percentile of pixels after exposure, when pictures are compared."""

AIM_DB = 36.0
"""Agreement by pixel that is aimed at, or Cycles' with itself less 1 dB where that is lower."""

OBJECT_VIEWS = 4
"""Views of each object alone."""

SCRIPT_SPP = 128
"""Samples of the denoised pictures of objects, as scripts for Blender have it: no stated error."""

SKIES = ("sun_and_sky", "clouds", "softboxes", "night")
"""Families of skies; the first has a sharp sun."""

_SEEN = ("sun_and_sky", "softboxes")
"""Families of skies that are visible to cameras."""

_MAPPED_SEED = 20_261_125
_SKY_ROWS = 128

_ROUGH = (0.4, 1.0)
_CALM = {
    "num_views": 1,
    "textures.share": 0.8,
    "textures.surfaces.roughness_clip": _ROUGH,
    "materials.roughness_clip": _ROUGH,
}
"""Changes that leave out mirrors, whose caustics would be too noisy for a comparison."""

_BLOCK_PX = 8
_MOST_SCENES = 10


def _points(scale: BenchScale, options: BenchOptions) -> list[Point]:
    kinds = [PLAIN, TEXTURED, SKY, *([GIVEN] if options.scenes else [])]
    points = [
        Point(name=kind, measure=partial(_measure, kind), kind=kind, judged=False) for kind in kinds
    ]
    return [*points, Point(name=OBJECT, measure=_measure_object, kind=OBJECT, judged=False)]


def _scene(context: BenchContext, kind: str, index: int) -> Scene:
    if kind == PLAIN:
        return context.scene(f"sampled {index}")
    if kind == GIVEN:
        names = list(given_scenes(context.options.scenes))
        return context.scene(names[index % len(names)])
    settings: SceneSettings = apply_overrides(textured_256().scenes, _CALM)
    if kind == SKY:
        row = index % len(SKIES)
        sky = {
            "skies.share": 1.0,
            "skies.over_lamps_log": (2.0, 2.0),
            "skies.seen_share": float(SKIES[row] in _SEEN),
            "skies.maps.families": (SKIES[row],),
            "skies.maps.height": _SKY_ROWS,
        }
        settings = apply_overrides(settings, sky)
        index = 10 + row
    return context.child.call_method(SceneWorker.compose_first, settings, index, _MAPPED_SEED)


def _measure(kind: str, context: BenchContext, trial: str) -> Figures:
    spp = context.scale.max_spp
    scene = _scene(context, kind, int(trial.split()[-1]))
    camera = first_camera(scene, RESOLUTION)
    ours = context.child.call(raw_reference, scene, camera, OUR_SHARE * spp)
    view = context.child.call(
        render_shot, scene, adaptive_settings(USUAL_FLOOR_DB, RESOLUTION, spp)
    )
    pictures, core_s = render_with_cycles(scene, RESOLUTION, spp, seeds=(0, 1))
    theirs = np.stack(pictures).astype(np.float64)
    true_db = {
        f"to_{name}_db": true_error_db(view.radiance_rgb, reference, log10_radiance)[0]
        for name, reference in (("ours", ours), ("theirs", theirs))
    }
    return {
        "core_s": core_s,
        **agreement_figures(ours, theirs),
        "stated_db": view.noise_floor_db,
        **true_db,
    }


def _measure_object(context: BenchContext, trial: str) -> Figures:
    """Return figures of views of an object alone, per view, by both renderers.

    Errors are over the pixels that show the object. One half of their reference is of our samples,
    the other of Cycles': neither renderer is its own judge.
    """
    px = context.scale.picture_px
    spp = context.scale.max_spp
    views = range(OBJECT_VIEWS)
    preset = object_views()
    scene = preset_scene(context.child, preset, int(trial.split()[-1]), OBJECT_VIEWS)
    settings = dataclasses.replace(preset.renders, resolution=px)
    ours, our_core_s = context.child.call(render_shots, scene, settings, OBJECT_VIEWS)
    filtered, core_s = render_with_cycles(scene, px, SCRIPT_SPP, views=views, denoise=True)
    raws, _ = render_with_cycles(scene, px, spp, seeds=(0, 1), views=views)
    figures: dict[str, list[float]] = {"stated_objects_db": [], "ours_db": [], "theirs_db": []}
    for view in views:
        camera = pixel_camera(scene.c2w[view], scene.fov_deg[view], px)
        raw = context.child.call(raw_reference, scene, camera, OUR_SHARE * spp, view)
        theirs = np.stack(raws[2 * view : 2 * view + 2]).astype(np.float64)
        if view == 0:
            agreement = agreement_figures(raw, theirs)
        both = np.stack([raw.mean(axis=0), theirs.mean(axis=0)])
        figures["stated_objects_db"].append(ours[view].object_noise_floor_db)
        for name, picture in (("ours_db", ours[view].radiance_rgb), ("theirs_db", filtered[view])):
            error_db, _ = true_error_db(picture, both, log10_radiance, ours[view].hits)
            figures[name].append(error_db)
    return {
        "core_s": core_s / OBJECT_VIEWS,
        "our_core_s": our_core_s / OBJECT_VIEWS,
        "missed": float((np.subtract(figures["stated_objects_db"], figures["ours_db"]) > 1).mean()),
        **agreement,
        **{name: float(np.mean(values)) for name, values in figures.items()},
    }


def agreement_figures(ours: RawReference, theirs: RawReference) -> dict[str, float]:
    """Return the agreement of Trilight with Cycles in dB, also without the noise of both.

    All pictures have one exposure, so that nine tenths of the pixels are below EXPOSED; values
    above 1 count as 1.
    """
    level = float(np.quantile(theirs.mean(axis=0).mean(axis=-1), 0.9))
    exposure = EXPOSED / level if level > 0 else 1.0
    ours = ours * exposure
    theirs = theirs * exposure
    pixels_db = _linear_db(ours.mean(axis=0), theirs[0])
    seeds_db = _linear_db(*theirs)
    blocks = ours.shape[1] // _BLOCK_PX
    coarse = shrink_reference(ours, blocks), shrink_reference(theirs, blocks)
    return {
        "pixels_db": pixels_db,
        "seeds_db": seeds_db,
        "margin_db": pixels_db - min(AIM_DB, seeds_db - 1),
        "blocks_db": _linear_db(*(each.mean(axis=0) for each in coarse)),
        "noiseless_db": difference_db(ours, theirs, clamped_radiance),
        "brightness": 100 * float(ours.mean() / theirs.mean() - 1),
    }


def _linear_db(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    return float(psnr_linear_db(one.astype(np.float32), other.astype(np.float32)))


EXPERIMENT = Experiment(
    name="cycles",
    title="Plain, textured and sky-lit scenes compared with Blender's Cycles",
    cost=Column("core-seconds of Cycles", "core_s"),
    error=Column("agreement without noise, linear dB", "noiseless_db"),
    better="higher",
    columns=(
        Column("by pixel, linear dB", "pixels_db"),
        Column("at least, dB", "pixels_db", over="least"),
        Column("Cycles with itself, dB", "seeds_db"),
        Column("over the aim, least dB", "margin_db", over="least"),
        Column("means of 8 x 8, dB", "blocks_db"),
        Column("ours brighter by, median %", "brightness"),
        Column("at most, %", "brightness", over="most"),
        Column("at least, %", "brightness", over="least"),
        Column("stated psnr_log_db", "stated_db"),
        Column("to our samples, dB", "to_ours_db"),
        Column("to Cycles' samples, dB", "to_theirs_db"),
        Column("objects: core-seconds of ours a view", "our_core_s"),
        Column("objects: stated over them, dB", "stated_objects_db"),
        Column("objects: true error of ours, dB", "ours_db"),
        Column("objects: views over 1 dB worse than stated, %", "missed", "mean", percent),
        Column("objects: that of Cycles denoised, dB", "theirs_db"),
    ),
    because="A sky a quarter turn off, a mirrored texture or colors decoded twice would each cost "
    "ten decibels and more. Where a picture is as far from Cycles' samples as from our own, its "
    "own noise is all that is left between it and either truth.",
    points=_points,
    trials=lambda scale, options: [
        f"scene {index}" for index in range(min(_MOST_SCENES, scale.scenes))
    ],
    needs=("blender",),
)
