"""What a training step would take on a card, from kernels that are counted and never run.

No card is needed: torch's fake tensors go through the project's own step (infra.fake_card), and a
stated model of kernels gives the time (infra.bench.roofline). It predicts, and proves no speed.
"""

from collections.abc import Sequence
from typing import Any

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Figures, Point, TurnFigures, percent
from infra.bench.workshop import Workshop

QUICK_RUNS = ("smoke", "pretrain")
WIDE_RUNS = ("pretrain", "finetune")
"""Runs that are shown at every size."""


def _points(effort: Effort) -> Sequence[Point]:
    """Return each run, kernel by kernel and compiled, and ours at every size."""
    from infra.bench.roofline.case import Case
    from model.config import SIZES
    from train.runs import RUNS, named_run

    quick = effort.name == "quick"
    cases: list[tuple[str, Case]] = []
    for run in QUICK_RUNS if quick else RUNS:
        cases += [
            (f"{run}, kernel by kernel", Case(run=run, is_compiled=False)),
            (f"{run}, compiled", Case(run=run)),
        ]
        settings = named_run(run)
        if not quick and settings.precision == "bfloat16" and run in WIDE_RUNS:
            other = not settings.recompute_activations
            how = "recomputed" if other else "not recomputed"
            cases.append((f"{run}, compiled, {how}", Case(run=run, recomputes=other)))
    for run in () if quick else WIDE_RUNS:
        own = named_run(run).model
        cases += [
            (f"{run} {size}, compiled", Case(run=run, size=size))
            for size, make in SIZES.items()
            if make().view_stage == own.view_stage and make() != own and size != "smoke"
        ]
    return [Point(name=name, settings=case) for name, case in cases]


def _measure(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    from infra.bench.roofline.row import roofline
    from infra.fake_card.process import card_process

    process = workshop.entered(card_process(workshop.folder()))
    for point in points:
        yield point.name, _figures(process.submit(roofline, point.settings).result())


def _figures(row: Any) -> Figures:
    kinds = row.by_kind_ms
    return {
        "ms": row.milliseconds,
        "kernels": row.kernels,
        "casts": row.casts,
        "gigabytes": row.gigabytes,
        "teraflops": row.teraflops,
        "attention_ms": kinds.get("attention", 0.0),
        "products_ms": kinds.get("product", 0.0) + kinds.get("convolution", 0.0),
        "pointwise_share": row.pointwise_share,
        "peak_share": row.peak_share,
        "waits": row.waits,
        "window_waits": row.window_waits,
        "scenes": row.scenes,
        "peak_gib": row.peak_gib,
        **{f"fit {name}": count for name, count in row.scenes_that_fit.items()},
    }


EXPERIMENTS = (
    Experiment(
        name="roofline",
        title="A training step on a card that is not there",
        about="One step of one pass: forward, loss, backward, clipping and the update, on one "
        "H100 of 80 GB. Scenes have the most triangles that the run takes, 3 % of them padding.",
        cost=Column(name="ms a step", figure="ms"),
        columns=(
            Column(name="kernels", figure="kernels"),
            Column(name="of them casts", figure="casts"),
            Column(name="GB moved", figure="gigabytes"),
            Column(name="TFLOP", figure="teraflops"),
            Column(name="attention, ms", figure="attention_ms"),
            Column(name="products, ms", figure="products_ms"),
            Column(name="casts and elementwise, %", figure="pointwise_share", then=percent),
            Column(name="share of peak, %", figure="peak_share", then=percent),
            Column(name="waits a step", figure="waits"),
            Column(name="a window", figure="window_waits"),
            Column(name="scenes", figure="scenes"),
            Column(name="peak GiB", figure="peak_gib"),
            Column(name="scenes that fit 40 GB", figure="fit A100-40"),
            Column(name="80 GB", figure="fit H100-80"),
            Column(name="141 GB", figure="fit H200-141"),
        ),
        points=_points,
        turns=lambda effort: ["counted"],
        measure=_measure,
        by_point=True,
        because="A prediction; what cards have shown of it is in "
        "docs/log/2026-11-26-an-h100.md and -on-a-card.md. A kernel takes the longest of "
        "its launch (4 us), its bytes (80 % of 3.35 TB/s) and its products (65 % of 989 TFLOP/s in "
        "bfloat16, 50 % of 494 in TF32; flash attention 40 % forth and 30 % back, on packed "
        "sequences 32 and 24, with a mask 20 and 12). `compiled` is an estimate too: neighbours "
        "that inductor may merge are counted as one kernel (infra/bench/roofline/fusion.py). "
        "FLOPs are those that are executed, recomputation included. Scenes fit if 90 % of the "
        "memory is enough, and what is held beyond the weights grows with them.",
        needs=("torch",),
    ),
)
