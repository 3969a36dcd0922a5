"""A trained network against the path tracer with its denoiser, at equal error of the picture."""

import contextlib
import itertools
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from infra.bench.render_child import render_child
from infra.bench.renders.equal_error import EqualError, Priced, at_error
from infra.bench.renders.levels import Levels
from infra.bench.trade.bare_pictures import bare_pictures
from infra.bench.trade.curves import Curve, Knob, Point
from infra.bench.trade.engine_scenes import HeldOut, build_within, held_out
from infra.bench.trade.workshop import Workshop
from pipeline.isolation import IsolatedChild
from pipeline.objects.generated import BENCHMARK
from storage.conventions import log10_radiance
from storage.metrics import psnr_log_db
from storage.scene import Scene
from train.data.resolution import block_mean

if TYPE_CHECKING:
    from model.neural_renderer import NeuralRenderer

NAME = "engines"
NETWORK, DENOISED, RAW = "network", "path tracer, denoised", "path tracer, raw"
_REPEATS = 3
"""Counted passes of the network over each scene."""
Row = dict[str, float | str]
Picture = NDArray[np.float32]


def measure_engines(shop: Workshop) -> Curve:
    """Measure a checkpoint against the path tracer; see the module."""
    from model.neural_renderer import NeuralRenderer

    renderer = NeuralRenderer.load(shop.options.checkpoint, device="cpu")
    build = build_within(renderer.trained.max_triangles)
    px, spp = shop.effort.resolution, 4 * shop.effort.max_spp
    threads = os.cpu_count() or 1
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        child = render_child(folder, build, objects=BENCHMARK, threads=threads)
        stack.enter_context(contextlib.closing(child))
        tried = (child.call(held_out, build, row, px, spp) for row in range(2 * shop.effort.scenes))
        made = (one for one in tried if one is not None)
        scenes = itertools.islice(made, shop.effort.scenes)  # no further one is rendered
        width = _resolution(renderer, px)
        rows = [_row(index, one, renderer, child, width, shop) for index, one in enumerate(scenes)]
    words = f"{len(rows)} scenes of objects of `{BENCHMARK}`, at most {build.scenes.max_triangles}"
    network = f"{Path(shop.options.checkpoint).name}, {renderer.digest[:8]}"
    size = f"triangles, {width} x {width}"
    return Curve(
        points=_points(rows),
        measured_on="; ".join([f"{words} {size}", network, *renderer.resolution_notes(width)]),
        details=tuple(rows),
    )


def _resolution(renderer: "NeuralRenderer", px: int) -> int:
    """Return the width that the network was trained on, where references can be reduced to it."""
    trained = renderer.trained.resolution
    return trained if trained is not None and trained <= px and px % trained == 0 else px


def _reference(one: HeldOut, px: int) -> Picture:
    return block_mean(one.reference.radiance_rgb[None], px)[0]


def _row(
    index: int,
    one: HeldOut,
    renderer: "NeuralRenderer",
    child: IsolatedChild,
    px: int,
    shop: Workshop,
) -> Row:
    """Return the figures of one scene."""
    reference = _reference(one, px)
    picture, encoding_core_s, view_core_s = _timed(renderer, one.scene, px)
    db = psnr_log_db(picture, reference)
    levels_spp = [1 << step for step in range(shop.effort.max_spp.bit_length())]
    raw, denoised = child.call(bare_pictures, one.scene, px, levels_spp)
    error = np.abs(log10_radiance(picture) - log10_radiance(reference))
    return {
        "scene": f"held-out {index}",
        "triangles": float(one.scene.num_triangles),
        "reference floor dB": one.reference.noise_floor_db,
        "network dB": db,
        "network log L1": float(error.mean()),
        "encoding core-s": encoding_core_s,
        "network view core-s": view_core_s,
        "loading core-s": raw.load_core_s,
        **_side("denoised", at_error(_priced(denoised, reference), db)),
        **_side("raw", at_error(_priced(raw, reference), db)),
    }


def _timed(renderer: "NeuralRenderer", scene: Scene, px: int) -> tuple[Picture, float, float]:
    """Return the first view, and median core-seconds of encoding and of the view, once warm."""
    spent = []
    for _ in range(1 + _REPEATS):
        marks = [time.process_time()]
        prepared = renderer.prepare(scene)
        marks.append(time.process_time())
        picture = renderer.view(prepared, scene.c2w[0], float(scene.fov_deg[0]), px)
        marks.append(time.process_time())
        spent.append(np.diff(marks))
    encoding, view = np.median(spent[1:], axis=0)  # memory and threads are new to the first
    return picture, float(encoding), float(view)


def _priced(found: Levels, reference: Picture) -> list[Priced]:
    return [
        Priced(spp=one.spp, core_s=one.core_s, db=psnr_log_db(one.radiance_rgb, reference))
        for one in found.levels
    ]


def _side(name: str, found: EqualError) -> Row:
    return {
        f"{name} bound": found.bound,
        f"{name} samples": found.spp,
        f"{name} view core-s": found.core_s,
    }


def _points(rows: Sequence[Row]) -> tuple[Point, ...]:
    """Return what the first view of a scene takes on each side, all at the network's error."""
    error = _median(rows, "network dB")
    log_l1 = _median(rows, "network log L1")
    sides: Mapping[str, tuple[str, str, dict[str, float]]] = {
        NETWORK: ("encoding core-s", "network view core-s", {"log L1": log_l1}),
        DENOISED: ("loading core-s", "denoised view core-s", _samples(rows, "denoised")),
        RAW: ("loading core-s", "raw view core-s", _samples(rows, "raw")),
    }
    return tuple(
        Point(
            setting=name,
            cost=_median(rows, shared) + _median(rows, view),
            error=error,
            default=name == DENOISED,
            further={"a further view, core-s": _median(rows, view), **more},
        )
        for name, (shared, view, more) in sides.items()
    )


def _samples(rows: Sequence[Row], side: str) -> dict[str, float]:
    bounds = [row[f"{side} bound"] for row in rows]
    return {
        "samples": _median(rows, f"{side} samples"),
        "scenes where 1 sample is better %": 100 * bounds.count("at most") / len(bounds),
        "scenes where no samples suffice %": 100 * bounds.count("more than") / len(bounds),
    }


def _median(rows: Sequence[Row], name: str) -> float:
    return float(np.median([float(row[name]) for row in rows]))


KNOBS = (
    Knob(
        name=NAME,
        title="Path tracer and denoiser, or a network",
        covers=("render.engine", "render.checkpoint"),
        cost="core-seconds of the first view of a scene, loading or encoding it included",
        error="psnr_log_db, dB",
        better="higher",
        against="converged pictures of scenes whose objects no network learnt from. All rows have "
        "the network's error: the path tracer is given as many samples as it needs for that, guide "
        "pictures and one denoise. Where one sample is better already, its cost stands, which is "
        "too high; where no measured number of samples is as good, that of the most, too low",
        because="the path tracer: the error of its picture is chosen and measured, that of a "
        "network is what its training left. The published factor of about 50 compares seconds on "
        "a graphics card with a fixed, high number of samples; at equal error the path tracer is "
        "asked for far fewer. A network is worth it where one scene is shown from many sides, "
        "since it is encoded once, and where its error will do.",
        measure=measure_engines,
        needs=("torch",),
    ),
)
