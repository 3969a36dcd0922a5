"""How long paths are: the depth at which they are cut, and where roulette may end them."""

import dataclasses

import numpy as np

from infra.bench.renders.fixed_samples import fixed_samples
from infra.bench.trade.curves import Curve, Knob, Point
from infra.bench.trade.render_knobs import points
from infra.bench.trade.rendered import shots
from infra.bench.trade.workshop import Workshop
from pipeline.renders.settings import RenderSettings
from storage.metrics import psnr_log_db

DEPTHS = (2, 3, 4, 6, 8, 10, 16)
DEEPEST = 32
"""Edges of the paths that shorter ones are compared with; hardly any path is longer."""
ROULETTE = (2, 3, 5, 8)


def measure_depth(shop: Workshop) -> Curve:
    """Measure the light that is lost with paths of so many edges."""
    effort = shop.effort
    base = fixed_samples(effort.resolution, effort.fixed_spp)
    variants = {depth: dataclasses.replace(base, max_depth=depth) for depth in (*DEPTHS, DEEPEST)}
    named = {f"{depth}": settings for depth, settings in variants.items()}
    taken = [shop.call(shots, subject.scene, named) for subject in shop.subjects]
    found = []
    for depth in DEPTHS:
        pairs = [(of_scene[f"{depth}"], of_scene[f"{DEEPEST}"]) for of_scene in taken]
        pictures = [(one.view.radiance_rgb, all_.view.radiance_rgb) for one, all_ in pairs]
        lost = [1 - picture.mean() / whole.mean() for picture, whole in pictures]
        errors = [psnr_log_db(picture, whole) for picture, whole in pictures]
        found.append(
            Point(
                setting=f"{depth}",
                cost=float(np.mean([one.core_s for one, _ in pairs])),
                error=float(np.median(errors)),
                default=depth == RenderSettings.max_depth,
                further={
                    "light lost %": 100 * float(np.mean(lost)),
                    "most light lost %": 100 * float(np.max(lost)),
                    "worst dB": min(errors),
                },
            )
        )
    words = f"{shop.scenes_in_words}, {effort.fixed_spp} samples"
    return Curve(points=tuple(found), measured_on=words)


def measure_roulette(shop: Workshop) -> Curve:
    """Measure the edge from which on paths may end by chance."""
    base = fixed_samples(shop.effort.resolution, shop.effort.fixed_spp)
    variants = {f"{depth}": dataclasses.replace(base, rr_depth=depth) for depth in ROULETTE}
    words = f"{shop.scenes_in_words}, {shop.effort.fixed_spp} samples"
    default = f"{RenderSettings.rr_depth}"
    return Curve(points=points(shop, variants, default), measured_on=words)


KNOBS = (
    Knob(
        name="depth",
        title="Length of paths",
        covers=("build.renders.max_depth",),
        cost="core-seconds a view",
        error="psnr_log_db, dB",
        better="higher",
        against=f"the same samples with paths of {DEEPEST} edges, so that noise is common to both; "
        "median over the scenes",
        because="10: roulette ends most paths long before, so further edges cost little, and what "
        "is cut off is below the noise of the pictures. Fewer edges darken a picture, which no "
        "number of samples brings back.",
        measure=measure_depth,
    ),
    Knob(
        name="roulette",
        title="Where roulette begins",
        covers=("build.renders.rr_depth",),
        cost="core-seconds a view",
        error="psnr_log_db, dB",
        better="higher",
        against="a converged reference of other samples; median over the scenes",
        because="2: it changes no mean, only noise and time, and ends dark paths soonest.",
        measure=measure_roulette,
    ),
)
