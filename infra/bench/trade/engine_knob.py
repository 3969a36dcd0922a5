"""A trained network against the path tracer with its denoiser, at equal error of the picture."""

import contextlib
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from infra.bench.render_child import render_child
from infra.bench.trade.bare_pictures import Bare, BarePictures, bare_pictures
from infra.bench.trade.curves import Curve, Knob, Point
from infra.bench.trade.engine_scenes import HeldOut, build_within, held_out
from infra.bench.trade.equal_error import EqualError, Priced, at_error
from infra.bench.trade.workshop import Workshop
from pipeline.isolation import IsolatedChild
from storage.conventions import log10_radiance
from storage.metrics import psnr_log_db
from train.data.resolution import block_mean

if TYPE_CHECKING:
    from model.neural_renderer import NeuralRenderer

NETWORK, DENOISED, RAW = "network", "path tracer, denoised", "path tracer, raw"
Row = dict[str, float | str]
Picture = NDArray[np.float32]


def measure_engines(shop: Workshop) -> Curve:
    """Measure a checkpoint against the path tracer; see the module."""
    from model.neural_renderer import NeuralRenderer

    assert shop.options.checkpoint is not None
    renderer = NeuralRenderer.load(shop.options.checkpoint, device="cpu")
    build = build_within(renderer.trained.max_triangles)
    px, spp = shop.effort.resolution, 4 * shop.effort.max_spp
    threads = os.cpu_count() or 1
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        child = render_child(folder, build, objects="builtin:", threads=threads)
        stack.enter_context(contextlib.closing(child))
        found = (child.call(held_out, build, row, px, spp) for row in range(2 * shop.effort.scenes))
        scenes = [one for one in found if one is not None][: shop.effort.scenes]
        width = _resolution(renderer, px)
        rows = [_row(index, one, renderer, child, width, shop) for index, one in enumerate(scenes)]
    words = f"{len(rows)} scenes of held-out objects, at most {build.scenes.max_triangles}"
    name = Path(shop.options.checkpoint).name
    return Curve(
        points=_points(rows),
        measured_on=f"{words} triangles, {width} x {width}; {name}, {renderer.digest[:8]}",
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
    marks = [time.process_time()]
    prepared = renderer.prepare(one.scene)
    marks.append(time.process_time())
    picture = renderer.view(prepared, one.scene.c2w[0], float(one.scene.fov_deg[0]), px)
    marks.append(time.process_time())
    db = psnr_log_db(picture, reference)
    levels_spp = [1 << step for step in range(shop.effort.max_spp.bit_length())]
    traced: BarePictures = child.call(bare_pictures, one.scene, px, levels_spp)
    error = np.abs(log10_radiance(picture) - log10_radiance(reference))
    return {
        "scene": f"held-out {index}",
        "triangles": float(one.scene.num_triangles),
        "reference floor dB": one.reference.noise_floor_db,
        "network dB": db,
        "network log L1": float(error.mean()),
        "encoding core-s": marks[1] - marks[0],
        "network view core-s": marks[2] - marks[1],
        "loading core-s": traced.load_core_s,
        **_side("denoised", at_error(_priced(traced.denoised, reference), db)),
        **_side("raw", at_error(_priced(traced.raw, reference), db)),
    }


def _priced(levels: Sequence[Bare], reference: Picture) -> list[Priced]:
    return [
        Priced(spp=one.spp, core_s=one.core_s, db=psnr_log_db(one.radiance_rgb, reference))
        for one in levels
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
    at_most = [row[f"{side} bound"] == "at most" for row in rows]
    return {
        "samples": _median(rows, f"{side} samples"),
        "scenes where 1 sample is better %": 100 * float(np.mean(at_most)),
    }


def _median(rows: Sequence[Row], name: str) -> float:
    return float(np.median([float(row[name]) for row in rows]))


KNOBS = (
    Knob(
        name="engines",
        title="Path tracer and denoiser, or a network",
        covers=("render.engine", "render.checkpoint"),
        cost="core-seconds of the first view of a scene, loading or encoding it included",
        error="psnr_log_db, dB",
        better="higher",
        against="converged pictures of scenes of held-out objects. All rows have the network's "
        "error: the path tracer is given as many samples as it needs for that, guide pictures "
        "and one denoise. Where one sample is better already, its cost stands, which is too high",
        because="the path tracer: the error of its picture is chosen and measured, that of a "
        "network is what its training left. The published factor of about 50 compares seconds on "
        "a graphics card with a fixed, high number of samples; at equal error the path tracer is "
        "asked for far fewer.",
        measure=measure_engines,
        needs=("torch", "checkpoint"),
    ),
)
