"""Experiment `gpu`: throughput, correct pictures, and steps of every training preset on a GPU."""

import dataclasses
import itertools
import os
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

from infra.bench.context import BenchContext
from infra.bench.experiment import (
    BenchScale,
    Column,
    Experiment,
    Figures,
    Point,
    device_of,
)
from infra.bench.workloads.reading import time_reading
from infra.bench_options import BenchOptions
from storage.errors import TrilightError
from train.presets import TRAINING_PRESETS, training_preset

if TYPE_CHECKING:
    import torch

NETWORKS = ("builtin:tokens", "builtin:hits")
_QUICK_RUNS = ("pretrain", "hits")
_STEPS = {"full": 10, "quick": 3}
READ_AS = "pretrain"
"""Training preset whose augmentation is applied to samples that are read."""
_BATCH = 8
_READ_S = {"full": 10.0, "quick": 2.0}
_PRODUCT_WIDTH = {"cuda": 8192, "cpu": 512}
_COPIED_BYTES = {"cuda": 1 << 30, "cpu": 1 << 26}
_THREADS = (1, 2, 4, 8, 16)

Measured = Callable[[BenchContext, "torch.device"], Figures]


def _points(scale: BenchScale, options: BenchOptions) -> list[Point]:
    device = device_of(options)
    on_gpu = device == "cuda"
    kinds = ("float32", "tf32", "bfloat16", "float16") if on_gpu else ("float32",)
    copies = ("within", "to_pageable", "to_pinned") if on_gpu else ("within",)
    precisions = ("float32", "bfloat16") if on_gpu else ("float32",)
    threads = [count for count in _THREADS if count <= (os.cpu_count() or 1)]
    works = [
        *itertools.product(["product"], kinds),
        *itertools.product(["copy"], copies),
        *itertools.product(["picture"], NETWORKS, precisions),
        *itertools.product(["step"], _runs(scale, options)),
    ]
    named: dict[str, Measured] = {
        **{", ".join(work): partial(_work, work[0], work[1:]) for work in works},
        "rendering a view": lambda context, device: context.rendered[0],
        **{f"reading a sample, {count} threads": partial(_reading, count) for count in threads},
    }
    return [Point(name=name, measure=partial(_measure, name, part)) for name, part in named.items()]


def _runs(scale: BenchScale, options: BenchOptions) -> Sequence[str]:
    if unknown := [name for name in options.run if name not in TRAINING_PRESETS]:
        raise TrilightError(
            f"bench gpu: --run {unknown[0]!r} is no training preset; expected some of "
            f"{', '.join(sorted(TRAINING_PRESETS))}."
        )
    if options.run:
        return options.run
    return (
        _QUICK_RUNS
        if scale.name == "quick"
        else [name for name in TRAINING_PRESETS if TRAINING_PRESETS.is_ours(name)]
    )


def _measure(name: str, part: Measured, context: BenchContext, trial: str) -> Figures:
    """Measure a part; one that fails has no figures, and a note with the reason."""
    import torch

    from infra.bench.gpu.steps import device_facts

    device = torch.device(device_of(context.options))
    context.note(device_facts(device))
    try:
        return part(context, device)
    except (RuntimeError, TrilightError) as error:  # those of CUDA and of torch's compiler too
        context.note(f"{name} was not measured: {type(error).__name__}")
        return {}


def _work(
    kind: str, words: Sequence[str], context: BenchContext, device: "torch.device"
) -> Figures:
    """Measure a product, a copy, a picture or a step."""
    from infra.bench.gpu import steps  # imports torch

    match kind, *words:
        case "product", number_type:
            return steps.product_figures(device, number_type, _PRODUCT_WIDTH[device.type])
        case "copy", way:
            return steps.copy_figures(device, way, _COPIED_BYTES[device.type])
        case "picture", network, precision:
            return steps.twin_figures(network, precision, device)
    figures = steps.step_figures(words[0], _STEPS[context.scale.name], device)
    if not figures:
        context.note(f"{words[0]}: too little memory, even for one scene a pass")
    return figures


def _reading(threads: int, context: BenchContext, device: "torch.device") -> Figures:
    """Decode and augment samples as a training preset does."""
    run = training_preset(READ_AS)
    settings = dataclasses.replace(
        run, scenes_per_step=_BATCH, resolution=context.scale.picture_px, most_triangles=0
    )
    least_s = _READ_S[context.scale.name]
    seconds, core_s = time_reading(context.data, settings, threads, least_s=least_s)
    return {
        "ms": 1e3 * seconds, "views_per_s": run.views_per_scene / seconds, "core_s": core_s
    }  # fmt: skip


EXPERIMENT = Experiment(
    name="gpu",
    title="The GPU: products, copies, pictures, steps, and what feeds it",
    about="Large products and copies, pictures of the built-in networks against stored ones, "
    "steps of the training presets at their own sizes, rendering, and reading; without a GPU the "
    "same at toy sizes, which shows that it works.",
    cost=Column("ms", "ms"),
    columns=(
        Column("TFLOP/s", "teraflop_per_s"),
        Column("GB/s", "gigabyte_per_s"),
        Column("to the stored picture, dB", "db"),
        Column("views/s", "views_per_s"),
        Column("scenes a pass", "scenes"),
        Column("not compiled, ms", "plain_ms"),
        Column("GiB", "peak_gib"),
        Column("kernels", "kernels"),
        Column("core-s", "core_s"),
    ),
    because="Pictures below 40 dB of the stored ones are wrong: believe no time then. The file "
    "names no host, user or folder; to send it, attach it to an issue.",
    points=_points,
    trials=lambda scale, options: ["round 1"],
    needs=("torch",),
)
