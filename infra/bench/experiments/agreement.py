"""Our pictures beside raw ones of Blender's Cycles: what of their difference is not noise."""

import os
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Point, TurnFigures
from infra.bench.experiments.beside import adaptive
from infra.bench.experiments.sampling import CORE_S
from infra.bench.sides.cycles import Request, cycles_picture
from infra.bench.sides.judged_pictures import (
    Reference,
    difference_db,
    raw_reference,
    shrunk,
    true_error_db,
)
from infra.bench.sides.sampled_pictures import first_camera
from infra.bench.sides.shots import Shot, shots
from infra.bench.subjects.named_scenes import sampled_names
from infra.bench.workshop import Workshop
from pipeline.renders.noise_floor import clamped_radiance
from pipeline.renders.settings import RenderSettings
from storage.conventions import log10_radiance
from storage.records.scene import Scene

TARGETS_DB = (40.0, 46.0)
_CURVES = {"log": log10_radiance, "linear": clamped_radiance}
_BLOCK_PX = 8


def _points(effort: Effort) -> list[Point]:
    return [
        Point(
            name=f"stated {target_db:.0f} dB",
            settings=adaptive(target_db, effort.resolution, effort.max_spp),
        )
        for target_db in TARGETS_DB
    ]


def our_side(
    scene: Scene, variants: Mapping[str, RenderSettings], resolution: int, spp: int
) -> tuple[Mapping[str, Shot], Reference]:
    """Return our pictures of the first view and its raw halves; runs in a render child."""
    reference = raw_reference(scene, first_camera(scene, resolution), spp)
    return shots(scene, variants), reference


def _their_side(scene: Scene, resolution: int, spp: int) -> Reference:
    halves: list[NDArray[np.float64]] = []
    for seed in range(2):
        request = Request(
            resolution=resolution,
            spp=spp // 2,
            denoise=False,
            seed=seed,
            threads=os.cpu_count() or 1,
        )
        halves.append(cycles_picture(scene, 0, request).radiance_rgb.astype(np.float64))
    return Reference(a_rgb=halves[0], b_rgb=halves[1])


def _measure(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    effort = workshop.effort
    scene = workshop.scene(turn)
    variants = {point.name: point.settings for point in points}
    spp, px = 2 * effort.max_spp, effort.resolution
    taken, ours = workshop.call(our_side, scene, variants, px, spp)
    theirs = _their_side(scene, px, spp)
    between = _between(ours, theirs)
    for name, shot in taken.items():
        yield name, {"core_s": shot.core_s, **_of_picture(shot, ours, theirs), **between}


def _of_picture(shot: Shot, ours: Reference, theirs: Reference) -> dict[str, float]:
    view = shot.view
    everywhere = np.ones_like(view.hits)
    found = {
        "log_stated_db": view.noise_floor_db,
        "linear_stated_db": view.noise_floor_linear_db,
        "spp": float(view.spp),
    }
    for name, curve in _CURVES.items():
        for word, reference in (("ours", ours), ("theirs", theirs)):
            error_db, _ = true_error_db(view.radiance_rgb, reference, curve, everywhere)
            found[f"{name}_to_{word}_db"] = error_db
    return found


def _between(ours: Reference, theirs: Reference) -> dict[str, float]:
    blocks = len(ours.a_rgb) // _BLOCK_PX
    coarse = shrunk(ours, blocks), shrunk(theirs, blocks)
    means = [float((one.a_rgb + one.b_rgb).mean()) for one in (ours, theirs)]
    return {
        "log_between_db": difference_db(ours, theirs, log10_radiance),
        "linear_between_db": difference_db(ours, theirs, clamped_radiance),
        "log_blocks_db": difference_db(*coarse, log10_radiance),
        "brightness": 100 * (means[0] / means[1] - 1),
    }


EXPERIMENTS = (
    Experiment(
        name="agreement",
        title="Our pictures beside raw ones of Blender's Cycles",
        about="Pictures with their stated floors, held against raw samples of Cycles and of our "
        "own in two halves each, so that no noise of a reference and no denoiser is in the "
        "figures; the first run installs Blender (GPL-3, 380 MB) in its own environment.",
        cost=CORE_S,
        columns=(
            Column(name="stated psnr_log_db", figure="log_stated_db"),
            Column(name="to our raw samples, dB", figure="log_to_ours_db"),
            Column(name="to Cycles' raw samples, dB", figure="log_to_theirs_db"),
            Column(name="both renderers without noise, dB", figure="log_between_db"),
            Column(name="the same, means of 8 x 8, dB", figure="log_blocks_db"),
            Column(name="stated psnr_linear_db", figure="linear_stated_db"),
            Column(name="linear, to ours, dB", figure="linear_to_ours_db"),
            Column(name="linear, to Cycles', dB", figure="linear_to_theirs_db"),
            Column(name="linear, both without noise, dB", figure="linear_between_db"),
            Column(name="ours brighter by, median %", figure="brightness"),
            Column(name="at most, %", figure="brightness", over="most"),
            Column(name="at least, %", figure="brightness", over="least"),
        ),
        because="Where a picture is as far from Cycles' samples as from our own, its own noise is "
        "all that is left between it and either truth.",
        points=_points,
        turns=lambda effort: sampled_names(min(10, 2 * effort.scenes)),
        takes_scenes=True,
        measure=_measure,
        needs=("blender",),
    ),
)
