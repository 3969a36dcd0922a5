"""Experiment `gpu`: throughput, correct pictures, and steps of every training preset on a GPU."""

import os
from collections.abc import Callable, Iterator, Sequence
from functools import partial

from infra.bench.context import BenchContext
from infra.bench.experiment import (
    BenchScale,
    Column,
    Experiment,
    Figures,
    Point,
    device_of,
)
from infra.bench_options import BenchOptions
from storage.errors import TrilightError
from train.runs import RUNS

NETWORKS = ("builtin:tokens", "builtin:hits")
_QUICK_RUNS = ("pretrain", "hits")
_STEPS = {"full": 10, "quick": 3}
_READ_S = {"full": 10.0, "quick": 2.0}
_PRODUCT_WIDTH = {"cuda": 8192, "cpu": 512}
_COPIED_BYTES = {"cuda": 1 << 30, "cpu": 1 << 26}
_THREADS = (1, 2, 4, 8, 16)

Measured = Callable[[BenchContext], Figures]


def _points(scale: BenchScale, options: BenchOptions) -> list[Point]:
    device = device_of(options)
    on_gpu = device == "cuda"
    kinds = ("float32", "tf32", "bfloat16", "float16") if on_gpu else ("float32",)
    copies = ("within", "to_pageable", "to_pinned") if on_gpu else ("within",)
    precisions = ("float32", "bfloat16") if on_gpu else ("float32",)
    threads = [count for count in _THREADS if count <= (os.cpu_count() or 1)]
    named: dict[str, Measured] = {
        **{f"product, {kind}": partial(_product, kind) for kind in kinds},
        **{f"copy, {kind}": partial(_copy, kind) for kind in copies},
        **{
            f"picture, {network}, {precision}": partial(_picture, network, precision)
            for network in NETWORKS
            for precision in precisions
        },
        **{f"step, {run}": partial(_step, run) for run in _runs(scale, options)},
        "rendering a view": _rendering,
        **{f"reading a sample, {count} threads": partial(_reading, count) for count in threads},
    }
    return [Point(name=name, settings=measure) for name, measure in named.items()]


def _runs(scale: BenchScale, options: BenchOptions) -> Sequence[str]:
    if unknown := [name for name in options.run if name not in RUNS]:
        raise TrilightError(
            f"bench gpu: --run {unknown[0]!r} is no training preset; expected some of "
            f"{', '.join(sorted(RUNS))}."
        )
    if options.run:
        return options.run
    return _QUICK_RUNS if scale.name == "quick" else [name for name in RUNS if RUNS.is_ours(name)]


def _measure(
    context: BenchContext, points: Sequence[Point], trial: str
) -> Iterator[tuple[str, Figures]]:
    """Measure point by point; a failed point has no figures, and a note with the reason."""
    import torch

    from infra.bench.gpu.probe import device_facts

    context.note(device_facts(torch.device(device_of(context.options))))
    for point in points:
        try:
            figures = point.settings(context)
        except (RuntimeError, TrilightError) as error:  # those of CUDA and of torch's compiler too
            context.note(f"{point.name} was not measured: {type(error).__name__}")
            figures = {}
        yield point.name, figures


def _product(kind: str, context: BenchContext) -> Figures:
    import torch

    from infra.bench.gpu.probe import product_figures

    device = device_of(context.options)
    return product_figures(torch.device(device), kind, _PRODUCT_WIDTH[device])


def _copy(kind: str, context: BenchContext) -> Figures:
    import torch

    from infra.bench.gpu.probe import copy_figures

    device = device_of(context.options)
    return copy_figures(torch.device(device), kind, _COPIED_BYTES[device])


def _picture(network: str, precision: str, context: BenchContext) -> Figures:
    import torch

    from infra.bench.gpu.twin import twin_figures

    return twin_figures(network, precision, torch.device(device_of(context.options)))


def _step(run: str, context: BenchContext) -> Figures:
    import torch

    from infra.bench.gpu.steps import step_figures

    device = torch.device(device_of(context.options))
    figures, parts = step_figures(run, _STEPS[context.scale.name], device)
    if not figures:
        context.note(f"{run}: too little memory, even for one scene a pass")
    total = sum(parts.values()) or 1.0
    words = [f"{name} {100 * ms / total:.0f} %" for name, ms in list(parts.items())[:3]]
    if words:
        context.note(f"{run}: {', '.join(words)} of a step")
    return figures


def _rendering(context: BenchContext) -> Figures:
    return _render_data(context)[0]


def _reading(threads: int, context: BenchContext) -> Figures:
    from infra.bench.gpu.supply import read_figures

    data = context.options.data or _render_data(context)[1]
    seconds = _READ_S[context.scale.name]
    return read_figures(data, threads, context.scale.picture_px, seconds)


def _render_data(context: BenchContext) -> tuple[Figures, str]:
    """Return the figures of rendering here, and a dataset of the rendered scenes."""
    from infra.bench.gpu.supply import rendered_figures

    def render() -> tuple[Figures, str]:
        figures, data = rendered_figures(context.scale.picture_px, context.folder())
        return figures, str(data)

    return context.get_or_make("rendered", render)


EXPERIMENT = Experiment(
    name="gpu",
    title="The GPU: products, copies, pictures, steps, and what feeds it",
    about="Large products and copies, pictures of the built-in networks against stored ones, "
    "steps of the training presets at their own sizes, rendering, and reading; without a GPU the "
    "same at toy sizes, which shows that it works.",
    cost=Column(name="ms", figure="ms"),
    columns=(
        Column(name="TFLOP/s", figure="teraflop_per_s"),
        Column(name="GB/s", figure="gigabyte_per_s"),
        Column(name="to the stored picture, dB", figure="db"),
        Column(name="views/s", figure="views_per_s"),
        Column(name="scenes a pass", figure="scenes"),
        Column(name="not compiled, ms", figure="plain_ms"),
        Column(name="GiB", figure="peak_gib"),
        Column(name="kernels", figure="kernels"),
        Column(name="core-s", figure="core_s"),
    ),
    because="Pictures below 40 dB of the stored ones are wrong: believe no time then. The file "
    "names no host, user or folder; to send it, attach it to an issue.",
    points=_points,
    trials=lambda scale, options: ["round 1"],
    measure=_measure,
    needs=("torch",),
)
