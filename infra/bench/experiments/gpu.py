"""Experiment `gpu`: throughput, correct pictures, and steps of every training preset on a GPU.

Without a GPU it measures the same at toy sizes, which shows that it works.
"""

import itertools
from collections.abc import Sequence
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
from train.presets import TRAINING_PRESETS

NETWORKS = ("builtin:tokens", "builtin:hits")
_QUICK_RUNS = ("pretrain", "hits")
_STEPS = {"full": 10, "quick": 3}
_PRODUCT_WIDTH = {"cuda": 8192, "cpu": 512}
_COPIED_BYTES = {"cuda": 1 << 30, "cpu": 1 << 26}


def _points(scale: BenchScale, options: BenchOptions) -> list[Point]:
    on_gpu = device_of(options) == "cuda"
    kinds = ("float32", "tf32", "bfloat16", "float16") if on_gpu else ("float32",)
    copies = ("within", "to_pageable", "to_pinned") if on_gpu else ("within",)
    precisions = ("float32", "bfloat16") if on_gpu else ("float32",)
    works = [
        *itertools.product(["product"], kinds),
        *itertools.product(["copy"], copies),
        *itertools.product(["picture"], NETWORKS, precisions),
        *itertools.product(["step"], _runs(scale, options)),
    ]
    return [Point(name=", ".join(work), measure=partial(_measure, work)) for work in works]


def _runs(scale: BenchScale, options: BenchOptions) -> Sequence[str]:
    for name in options.run:
        TRAINING_PRESETS.find(name)  # refuses an unknown one before anything is measured
    ours = [name for name in TRAINING_PRESETS if TRAINING_PRESETS.is_ours(name)]
    return options.run or (_QUICK_RUNS if scale.name == "quick" else ours)


def _measure(work: Sequence[str], context: BenchContext, trial: str) -> Figures:
    """Measure a work; one that fails has no figures, and a note with the reason."""
    import torch

    from infra.bench.workloads import gpu_steps as steps

    device = torch.device(device_of(context.options))
    context.note(steps.device_facts(device))
    figures: Figures = {}
    try:
        match work:
            case "product", number_type:
                figures = steps.product_figures(device, number_type, _PRODUCT_WIDTH[device.type])
            case "copy", way:
                figures = steps.copy_figures(device, way, _COPIED_BYTES[device.type])
            case "picture", network, precision:
                figures = steps.picture_figures(network, precision, device)
                if device.type == "cpu":
                    context.note("without a GPU a picture is compared with itself")
            case "step", run:
                figures = steps.step_figures(run, _STEPS[context.scale.name], device)
                if not figures:
                    context.note(f"{run}: too little memory, even for one scene a pass")
    except (RuntimeError, TrilightError) as error:  # those of CUDA and of torch's compiler too
        context.note(f"{', '.join(work)} was not measured: {type(error).__name__}")
    return figures


EXPERIMENT = Experiment(
    name="gpu",
    title="The GPU: products, copies, pictures and steps",
    cost=Column("ms", "ms"),
    columns=(
        Column("TFLOP/s", "teraflop_per_s"),
        Column("GB/s", "gigabyte_per_s"),
        Column("to the processor's picture, dB", "db"),
        Column("views/s", "views_per_s"),
        Column("scenes a pass", "scenes"),
        Column("not compiled, ms", "plain_ms"),
        Column("GiB", "peak_gib"),
    ),
    because="Pictures below 40 dB are wrong: believe no time then. The file "
    "names no host, user or folder; to send it, attach it to an issue.",
    points=_points,
    trials=lambda scale, options: ["round 1"],
    needs=("torch",),
)
