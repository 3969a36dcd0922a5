"""Experiment `frontier`: Trilight and plain Mitsuba at equal true error, and the stated errors.

Errors are true ones, to raw samples of Trilight's path tracer in two independent halves without
denoising, whose noise cancels. The renderers are measured alternately on every scene.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from infra.bench.context import BenchContext
from infra.bench.experiment import (
    BenchScale,
    Column,
    Experiment,
    Figures,
    Over,
    Point,
    percent,
)
from infra.bench.workloads.named_scenes import given_scenes
from infra.bench.workloads.traced_pictures import (
    figures,
    load_or_render_reference,
    render_levels,
    render_shot,
    shrink_reference,
)
from infra.bench_options import BenchOptions
from infra.render.methods import SAMPLE_SEED
from infra.render.raw_references import RawReference, true_error_db
from pipeline.presets.training import pretrain_256
from pipeline.renders.calibrated_error import LEAST_ERROR
from pipeline.renders.noise_floor import clamped_radiance, secant_slope
from pipeline.renders.settings import USUAL_FLOOR_DB, RenderSettings
from storage.conventions import log10_radiance
from storage.renderer import Image

TARGETS_DB = (38.0, 42.0, 46.0, 50.0)
STATED_PX = (64, 256)
"""Further widths at which stated errors are checked."""
REFERENCE_PX = 256
"""Width of the references in pixels, the largest one of the experiment."""

OURS = "Trilight, stated errors"
STATED = "Trilight, other widths"
PLAIN = {"independent": "plain Mitsuba", "multijitter": "plain Mitsuba, multijitter"}
"""Kinds of points by the sampler of plain Mitsuba: its default one, and its best stratified one."""

_SINGLE_PIXEL = 0.5
"""Share of the squared error from which one pixel decides what a picture costs."""


def adaptive_settings(target_db: float, resolution: int, max_spp: int) -> RenderSettings:
    """Return the settings of `pretrain-256` with another target, width and cap."""
    return dataclasses.replace(
        pretrain_256().renders,
        resolution=resolution,
        noise_floor_db=target_db,
        max_spp=max_spp,
        min_mean_radiance=0.0,
    )


def plain_spps(scale: BenchScale) -> tuple[int, ...]:
    """Return the numbers of samples of plain Mitsuba: squares, up to 16 times our cap."""
    return tuple(4**power for power in range(3, 1 + int(math.log2(16 * scale.max_spp) / 2)))


def _points(scale: BenchScale, options: BenchOptions) -> list[Point]:
    ours = [
        Point(
            name=f"trilight {target_db:.0f} dB",
            measure=partial(
                _measure_ours, adaptive_settings(target_db, scale.resolution, scale.max_spp)
            ),
            default=target_db == pretrain_256().renders.noise_floor_db,
            kind=OURS,
        )
        for target_db in TARGETS_DB
    ]
    stated = [
        Point(
            name=f"trilight {USUAL_FLOOR_DB:.0f} dB, {px} px",
            measure=partial(_measure_ours, adaptive_settings(USUAL_FLOOR_DB, px, scale.max_spp)),
            judged=False,
            kind=STATED,
        )
        for px in STATED_PX
        if px != scale.resolution
    ]
    plain = [
        Point(
            name=f"mitsuba {sampler} {spp}",
            measure=partial(_measure_plain, sampler, spp),
            kind=kind,
        )
        for sampler, kind in PLAIN.items()
        for spp in plain_spps(scale)
    ]
    return [*ours, *stated, *plain]


def _trials(scale: BenchScale, options: BenchOptions) -> list[str]:
    sampled = [f"sampled {index}" for index in range(scale.scenes)]
    return [*given_scenes(options.scenes), *sampled]


def _measure_ours(settings: RenderSettings, context: BenchContext, trial: str) -> Figures:
    view = context.child.call(render_shot, context.scene(trial), settings)
    reference = shrink_reference(_reference(context, trial), settings.resolution)
    judged = figures(view, reference)
    costs_and_errors = {"core_s": view.core_s, "db": judged["log_true_db"], **judged}
    if settings.resolution == context.scale.resolution:
        costs_and_errors |= _beside_plain(
            costs_and_errors,
            worst_pixel_share(view.radiance_rgb, reference),
            {sampler: _plain_levels(sampler, context, trial) for sampler in PLAIN},
        )
    return costs_and_errors


def _beside_plain(
    ours: Figures, worst_pixel: float, plain: Mapping[str, Mapping[int, Figures]]
) -> dict[str, float]:
    """Return what plain Mitsuba costs at the error of our picture, as times of our cost.

    `times` is that of the cheaper sampler. Where one pixel decides, the figures have other names,
    so that no median counts it.

    Args:
        ours: figures of our picture.
        worst_pixel: share of its squared error.
        plain: figures of plain Mitsuba's pictures by sampler and samples.
    """
    costs = dict[str, tuple[float, int]]()
    for sampler, levels in plain.items():
        steps = [(each["spp"], each["core_s"], each["db"]) for each in levels.values()]
        core_s, bound = cost_at_error(steps, ours["db"])
        costs[sampler] = core_s / ours["core_s"], bound
        near = min(levels.values(), key=lambda each: abs(each["db"] - ours["db"]))
        worst_pixel = max(worst_pixel, near["worst_pixel"])
    times, bound = min(costs.values())
    single = worst_pixel > _SINGLE_PIXEL
    named = {"times": times, **{f"times_{name}": cost for name, (cost, _) in costs.items()}}
    return {
        "single_pixel": float(single),
        **{f"{name}{'_of_one_pixel' if single else ''}": value for name, value in named.items()},
        "at_least": float(bound > 0),
        "at_most": float(bound < 0),
    }


def _measure_plain(sampler: str, spp: int, context: BenchContext, trial: str) -> Figures:
    return _plain_levels(sampler, context, trial)[spp]


def _reference(context: BenchContext, trial: str) -> RawReference:
    spp = context.scale.reference_spp
    return load_or_render_reference(context.child, context.scene(trial), REFERENCE_PX, spp)


def _plain_levels(sampler: str, context: BenchContext, trial: str) -> dict[int, dict[str, float]]:
    """Return the figures of plain Mitsuba by samples per pixel, ascending.

    Of a raw and a denoised picture the one nearer to the reference counts, which favors Mitsuba: a
    denoiser blurs what many samples know better.
    """

    def render() -> dict[int, dict[str, float]]:
        px = context.scale.resolution
        spps = plain_spps(context.scale)
        scene = context.scene(trial)
        levels = context.child.call(render_levels, scene, px, spps, SAMPLE_SEED, sampler)
        reference = shrink_reference(_reference(context, trial), px)
        return {
            spp: max((plain_figures(each, reference) for each in level), key=itemgetter("db"))
            for spp, level in zip(spps, levels, strict=True)
        }

    return context.get_or_make(("plain", sampler, trial), render)


def plain_figures(level: Image, reference: RawReference) -> dict[str, float]:
    """Return cost and true errors of a picture of plain Mitsuba."""
    db, open_db = true_error_db(level.radiance_rgb, reference, log10_radiance)
    linear_db, _ = true_error_db(level.radiance_rgb, reference, clamped_radiance)
    return {
        "core_s": level.cpu_seconds or 0.0,
        "spp": float(level.samples or 0),
        "db": db,
        "linear_true_db": linear_db,
        "log_open_db": open_db,
        "worst_pixel": worst_pixel_share(level.radiance_rgb, reference),
    }


def worst_pixel_share(picture_rgb: NDArray[np.float32], reference: RawReference) -> float:
    """Return which share of a picture's squared error (log) its worst pixel has, at most 1."""
    picture = picture_rgb.astype(np.float64)
    weight = np.square(secant_slope(log10_radiance, picture, reference.mean(axis=0)))
    squared = (weight * (picture - reference).prod(axis=0)).mean(axis=-1)
    worst = float(squared.max())
    return worst / max(float(squared.sum()), worst, LEAST_ERROR)


def cost_at_error(levels: Sequence[tuple[float, float, float]], db: float) -> tuple[float, int]:
    """Return the CPU seconds at which a path tracer reaches an error, and what bound that is.

    Between two levels dB are linear in log2 of the samples, and CPU seconds linear in the samples.
    Outside the measured range the nearest level counts: its cost is a lower bound (1) if no level
    is good enough, and an upper bound (-1) if all are better; 0 is no bound.

    Args:
        levels: samples per pixel, CPU seconds and psnr_log_db, rising in samples; at least one.
        db: psnr_log_db to reach, to the same reference.
    """
    row = next((row for row, (_, _, level_db) in enumerate(levels) if level_db >= db), None)
    if row is None:
        return levels[-1][1], 1
    spp_above, core_s_above, db_above = levels[row]
    if row == 0:
        return core_s_above, -1 if db_above > db else 0
    spp_below, core_s_below, db_below = levels[row - 1]
    fraction = (db - db_below) / (db_above - db_below)
    spp = spp_below * 2 ** (fraction * math.log2(spp_above / spp_below))
    slope = (core_s_above - core_s_below) / (spp_above - spp_below)
    return core_s_below + slope * (spp - spp_below), 0


_STATED: tuple[tuple[str, str, Over, Callable[[float], float]], ...] = (
    ("over 1 dB worse than stated, %", "over_1", "mean", percent),
    ("95 % interval from, %", "over_1", "low", percent),
    ("to, %", "over_1", "high", percent),
    ("over 3 dB, %", "over_3", "mean", percent),
    ("caution, median dB", "caution_db", "median", float),
    ("worst dB", "caution_db", "least", float),
)

_WRONG = tuple(
    Column(f"{metric}: {words}", f"{name}_{figure}", over=over, then=then)
    for name, metric in (("log", "log"), ("linear", "linear"), ("object", "objects"))
    for words, figure, over, then in (_STATED if name == "log" else _STATED[:1])
)

EXPERIMENT = Experiment(
    name="frontier",
    title="Cost at equal error compared with plain Mitsuba, and stated errors",
    cost=Column("core-seconds a view", "core_s", over="mean"),
    error=Column("psnr_log_db, dB", "db"),
    better="higher",
    columns=(
        Column("samples", "spp", over="mean"),
        Column("5th percentile, dB", "db", over="p5"),
        Column("linear, dB", "linear_true_db"),
        Column("Mitsuba's cost at equal error, times", "times"),
        Column("least times", "times", over="least"),
        *(Column(f"{sampler}, times", f"times_{sampler}") for sampler in PLAIN),
        Column("lower bounds, %", "at_least", over="mean", then=percent),
        Column("upper bounds, %", "at_most", over="mean", then=percent),
        Column("one pixel decides, %", "single_pixel", over="mean", then=percent),
        *_WRONG,
        Column("hit the sample limit, %", "at_cap", over="mean", then=percent),
        Column("what the reference leaves open, median dB", "log_open_db"),
    ),
    because="Mitsuba's cost at equal error is the median over the scenes of its core-seconds, "
    "interpolated between its numbers of samples, divided by ours; the better of its samplers "
    "counts. Where it cannot be interpolated it is a bound. Scenes in which one pixel has over "
    "half of the squared error are left out of it. A stated error is wrong where the true one is "
    "more than 1 dB (3 dB) worse; intervals are over scenes. Caution is by how much a picture is "
    "better than stated.",
    points=_points,
    trials=_trials,
)
