"""Textured and sky-lit scenes: our pictures beside what Blender's Cycles makes of our USD."""

import os
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Point, TurnFigures
from infra.bench.sides.cycles import CyclesSamples, Request, cycles_of_usd
from infra.bench.sides.judged_pictures import (
    Reference,
    difference_db,
    raw_reference,
    shrunk,
)
from infra.bench.sides.sampled_pictures import first_camera
from infra.bench.subjects.mapped_scenes import SKIES, TEXTURED, below_a_sun, mapped_scene
from infra.bench.workshop import Workshop
from pipeline.exchange.usd.write import write_usd
from pipeline.renders.noise_floor import clamped_radiance
from storage.metrics import psnr_linear_db
from storage.records.scene import Scene

RESOLUTION = 64
OUR_SHARE = 4
"""Samples of ours, in two halves, for each sample of one picture of Cycles: they cost less."""

EXPOSED = 0.5
"""Radiance that nine tenths of the pixels do not exceed where pictures are compared."""

AIM_DB = 36.0
"""Agreement by pixel that is aimed at, or Cycles' with itself less 1 dB where that is lower."""

_BLOCK_PX = 8


def _turns(effort: Effort) -> tuple[str, ...]:
    return (*TEXTURED, *(f"sky {name}" for name in SKIES))


def _scene(workshop: Workshop, turn: str) -> Scene:
    if turn in _turns(workshop.effort):
        return workshop.call(mapped_scene, turn)
    return below_a_sun(workshop.scene(turn))


def our_side(scene: Scene, spp: int) -> Reference:
    """Return raw samples of the first view in two halves; runs in a render child."""
    return raw_reference(scene, first_camera(scene, RESOLUTION), spp)


def _measure(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    scene = _scene(workshop, turn)
    for point in points:
        spp = point.settings
        ours = workshop.call(our_side, scene, OUR_SHARE * spp)
        usd = workshop.folder() / "scene.usdc"
        write_usd(usd, scene)
        request = Request(
            resolution=RESOLUTION, spp=spp, denoise=False, threads=os.cpu_count() or 1
        )
        theirs = cycles_of_usd(usd, request, (0, 1))
        yield point.name, {"core_s": theirs.core_s, **figures(ours, theirs)}


def figures(ours: Reference, theirs: CyclesSamples) -> dict[str, float]:
    """Return how well ours agree with a picture of theirs, in dB, and what of it is not noise.

    All pictures are exposed alike, so that nine tenths of the pixels are below EXPOSED: what is
    brighter than 1 counts as 1.
    """
    one, other = (picture.astype(np.float64) for picture in theirs.pictures_rgb)
    level = float(np.quantile((one + other).mean(axis=-1) / 2, 0.9))
    exposure = EXPOSED / level if level > 0 else 1.0
    one, other = one * exposure, other * exposure
    ours = Reference(a_rgb=ours.a_rgb * exposure, b_rgb=ours.b_rgb * exposure)
    their_halves = Reference(a_rgb=one, b_rgb=other)
    pixels_db = _linear_db(0.5 * (ours.a_rgb + ours.b_rgb), one)
    seeds_db = _linear_db(one, other)
    blocks = len(ours.a_rgb) // _BLOCK_PX
    coarse = shrunk(ours, blocks), shrunk(their_halves, blocks)
    return {
        "pixels_db": pixels_db,
        "seeds_db": seeds_db,
        "margin_db": pixels_db - min(AIM_DB, seeds_db - 1),
        "blocks_db": _linear_db(*(0.5 * (half.a_rgb + half.b_rgb) for half in coarse)),
        "noiseless_db": difference_db(ours, their_halves, clamped_radiance),
        "brightness": 100 * float((ours.a_rgb + ours.b_rgb).mean() / (one + other).mean() - 1),
    }


def _linear_db(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    return float(psnr_linear_db(one.astype(np.float32), other.astype(np.float32)))


EXPERIMENTS = (
    Experiment(
        name="textured-cycles",
        title="Textured and sky-lit scenes beside Blender's Cycles",
        about="Raw samples of ours against those that Cycles makes of our USD file after our "
        "script, in two pictures of the stated number, of scenes with procedural surfaces, of "
        "scenes below skies, and of the glTF files in `--scenes`; the first run installs "
        "Blender (GPL-3, 380 MB) in its own environment.",
        cost=Column(name="core-seconds of Cycles", figure="core_s"),
        columns=(
            Column(name="by pixel, linear dB", figure="pixels_db"),
            Column(name="at least", figure="pixels_db", over="least"),
            Column(name="Cycles with itself, dB", figure="seeds_db"),
            Column(name="over the aim, least dB", figure="margin_db", over="least"),
            Column(name="means of 8 x 8, dB", figure="blocks_db"),
            Column(name="at least, dB", figure="blocks_db", over="least"),
            Column(name="pixels without noise, dB", figure="noiseless_db"),
            Column(name="ours brighter by, median %", figure="brightness"),
            Column(name="at most, %", figure="brightness", over="most"),
            Column(name="least, %", figure="brightness", over="least"),
        ),
        because="A sky a quarter turn off, a mirrored texture or colours decoded twice would each "
        "cost ten decibels and more.",
        points=lambda effort: [Point(name=f"{effort.max_spp} samples", settings=effort.max_spp)],
        turns=_turns,
        takes_scenes=True,
        measure=_measure,
        needs=("blender",),
    ),
)
