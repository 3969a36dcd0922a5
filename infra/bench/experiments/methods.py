"""Experiment `methods`: cost against true error, from pure networks to the path tracer.

It renders one view each of held-out scenes (infra.render.held_out_scenes) on one thread, when
everything is warm.
"""

from collections.abc import Mapping
from functools import partial

import numpy as np

from infra.bench.context import BenchContext
from infra.bench.experiment import BenchScale, Column, Experiment, Figures, Point
from infra.bench.workloads.traced_pictures import load_or_render_reference
from infra.bench_options import BenchOptions
from infra.render.held_out_scenes import held_out_scene, held_out_settings
from infra.render.methods import (
    BUILTIN_NETWORKS,
    DIRECT_LIGHT,
    SAMPLES,
    TRACED_LIGHT,
    compared_renderers,
    kind_of,
    network_labels,
    network_name,
    samples_name,
)
from infra.render.path_tracer import RenderChild
from infra.render.raw_references import RawReference, true_error_db
from pipeline.isolation import IsolatedChild
from pipeline.objects.generated import BENCHMARK
from pipeline.renders.mitsuba_variant import choose_variant
from pipeline.renders.noise_floor import clamped_radiance
from storage.conventions import log10_radiance
from storage.raycast import first_hits
from storage.records.scene import Scene
from storage.renderer import Renderer

WIDTHS = (64, 256)

ROUNDS = 3
"""Measured rounds after the one that warms up; their median counts."""


def row_name(px: int, name: str) -> str:
    """Return the name of a method's row at a width."""
    return f"{px} px, {name}"


def _points(scale: BenchScale, options: BenchOptions) -> list[Point]:
    labels = network_labels(options.checkpoint)
    networks = [*BUILTIN_NETWORKS, *(one for one in labels if one not in BUILTIN_NETWORKS)]
    names = [
        *map(network_name, networks), DIRECT_LIGHT, TRACED_LIGHT, *map(samples_name, SAMPLES)
    ]  # fmt: skip
    first = network_name(labels[0])
    return [
        Point(
            name=row_name(px, name),
            measure=partial(_measure, px, name),
            group=f"{px} px",
            kind=kind_of(name),
            rival=None if name == first else row_name(px, first),
        )
        for px in WIDTHS
        for name in names
    ]


def _measure(px: int, name: str, context: BenchContext, trial: str) -> Figures:
    renderers, child = context.get_or_make("methods", lambda: _set_up(context))
    index = int(trial.split()[-1])
    scene = context.get_or_make(("scene", trial), lambda: held_out_scene(child, index))
    reference = load_or_render_reference(child, scene, px, 2 * context.scale.max_spp)
    return judged_figures(renderers[px, name], scene, reference)


def _set_up(
    context: BenchContext,
) -> tuple[Mapping[tuple[int, str], Renderer], IsolatedChild]:
    """Return the renderers by width and name, and a child that composes scenes and references."""
    from model.inference import NeuralRenderer

    paths = context.options.checkpoint
    paths_by_label = dict(zip(network_labels(paths), paths, strict=True))
    networks = {}
    for label, path in ({each: each for each in BUILTIN_NETWORKS} | paths_by_label).items():
        network = NeuralRenderer.load(path, device="cpu")
        networks[network_name(label)] = network
        context.note(f"{network_name(label)} is {network.digest[:8]}")
    context.note(f"differences are to {network_name(network_labels(paths)[0])}")
    child = context.until_closed(RenderChild(choose_variant(), threads=1))
    renderers = {
        (px, each.name): each for px in WIDTHS for each in compared_renderers(px, networks, child)
    }
    return renderers, context.render_child(held_out_settings(), BENCHMARK, threads=1)


def judged_figures(renderer: Renderer, scene: Scene, reference: RawReference) -> Figures:
    """Return the figures of a picture; its decibels exclude the noise of the reference."""
    from train.evaluation.evaluate import time_scene
    from train.evaluation.metrics import picture_scores

    picture = time_scene(renderer, scene, "scene", ROUNDS)
    radiance_rgb = picture.radiance_rgb
    hits = first_hits(scene, resolution=len(radiance_rgb)).met
    mean = reference.mean(axis=0)
    return {
        "core_s": picture.price.first_s,
        "view_s": picture.price.further_s,
        "db": true_error_db(radiance_rgb, reference, log10_radiance)[0],
        "object_db": true_error_db(radiance_rgb, reference, log10_radiance, hits)[0],
        "linear_db": true_error_db(radiance_rgb, reference, clamped_radiance)[0],
        "ssim": float(
            picture_scores(radiance_rgb, mean.astype(np.float32), hits, None)["ssim"] or 0.0
        ),
    }


EXPERIMENT = Experiment(
    name="methods",
    title="Methods to a picture: what is traced and what is learned",
    cost=Column("a scene's first view, core-s", "core_s"),
    error=Column("psnr_log_db, dB", "db"),
    better="higher",
    columns=(
        Column("a further view, core-s", "view_s"),
        Column("5th percentile, dB", "db", over="p5"),
        Column("more than the first network, dB", "db", over="pair"),
        Column("object, dB", "object_db"),
        Column("linear, dB", "linear_db"),
        Column("SSIM", "ssim"),
    ),
    also_cost=("a further view, core-s",),
    because="Errors are to raw samples in two halves: neither their noise nor a denoiser is in "
    "them. Differences are view by view, with the 95 % interval of their mean over scenes.",
    points=_points,
    trials=lambda scale, options: [f"held-out {index}" for index in range(scale.scenes)],
    needs=("torch",),
)
