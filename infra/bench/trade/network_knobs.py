"""The network with random weights: its precision, its attention, what it leaves out, its size.

Weights are random, as in `trilight bench model`, since costs do not depend on them. Errors do: what
rounding does to a trained network is measured by infra.bench.model.precision_parts, and what a size
is worth comes from the table of small trainings.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from infra.bench import harness
from infra.bench.trade.curves import Curve, Knob, Point
from infra.bench.trade.workshop import Workshop

if TYPE_CHECKING:
    from torch import Tensor

SKIPPING, WHOLE = "empty bundles skipped", "all bundles"


def measure_precision(shop: Workshop) -> Curve:
    """Measure a whole pass in each precision that a processor has."""
    import copy

    from infra.bench.model.cases import timed_forward
    from infra.bench.model.contenders import bright_network
    from infra.bench.model.network_errors import log10_psnr_db
    from infra.bench.trade.forward import CPU, forward_of, workload_of
    from model.config import SIZES
    from model.precision import PRECISIONS, set_precision

    effort, workload = shop.effort, workload_of(shop.effort)
    model = bright_network(SIZES[effort.network]())
    pictures: dict[str, Tensor] = {}

    def side(name: str) -> Callable[[], Mapping[str, float]]:
        forward = forward_of(set_precision(copy.deepcopy(model), name), workload)

        def run() -> Mapping[str, float]:
            pictures[name], figures = timed_forward(forward, CPU)
            return figures

        return run

    names = [name for name, precision in PRECISIONS.items() if not precision.needs_cuda]
    found = shop.in_turns("trade-precision", {name: side(name) for name in names})
    points = [
        Point(
            setting=name,
            cost=found[name]["core_s"],
            error=log10_psnr_db(pictures[name], pictures["float32"]),
            default=name == "float32",
        )
        for name in names
    ]
    return Curve(points=tuple(points), measured_on=_in_words(shop))


def _in_words(shop: Workshop) -> str:
    effort = shop.effort
    return (
        f"{effort.network} with random weights, {effort.network_triangles} triangles, one view of "
        f"{effort.network_px} x {effort.network_px}"
    )


def measure_attention(shop: Workshop) -> Curve:
    """Measure the ways to one attention layer of the encoder."""
    import torch

    from infra.bench.trade.attention_sides import DEFAULT, attention_sides, exact_attention
    from model.config import SIZES

    config = SIZES[shop.effort.network]()
    tokens = config.num_registers + shop.effort.network_triangles
    generator = torch.Generator().manual_seed(0)
    shape = (3, 1, config.num_heads, tokens, config.head_width)
    q, k, v = torch.randn(shape, generator=generator)
    outputs: dict[str, Tensor] = {}
    sides = attention_sides(q, k, v, outputs)
    found = shop.in_turns("trade-attention", sides)
    exact = exact_attention(q, k, v)
    points = [
        Point(
            setting=name,
            cost=found[name]["core_s"],
            error=float((outputs[name].double() - exact).abs().max()),
            default=name == DEFAULT,
        )
        for name in sides
    ]
    words = f"{config.num_heads} heads of {config.head_width}, {tokens} tokens, normal numbers"
    return Curve(points=tuple(points), measured_on=words)


def measure_bundles(shop: Workshop) -> Curve:
    """Measure the view stage with and without the bundles that see no geometry."""
    import torch

    from infra.bench.model.contenders import bright_network
    from infra.bench.trade.bundle_sides import bundle_figures
    from model.config import SIZES

    model = bright_network(SIZES[shop.effort.network]())
    px = shop.effort.network_px
    with torch.inference_mode():
        rows = [bundle_figures(model, subject.scene, px) for subject in shop.subjects]
    whole = float(np.mean([row.whole_core_s for row in rows]))
    skipping = float(np.mean([row.skipping_core_s for row in rows]))
    share = 100 * float(np.median([row.share_empty for row in rows]))
    error = float(np.median([row.psnr_log_db for row in rows]))
    points = (
        Point(setting=WHOLE, cost=whole, error=100.0, default=True),
        Point(setting=SKIPPING, cost=skipping, error=error, further={"empty bundles %": share}),
    )
    words = f"{len(rows)} scenes, {shop.effort.network} with random weights, {px} x {px}"
    return Curve(points=points, measured_on=words)


def measure_size(shop: Workshop) -> Curve:
    """Measure the time of every size; errors are those of small trainings, where there are any."""
    from infra.bench.model.cases import timed_forward
    from infra.bench.trade.forward import CPU, forward_of, workload_of
    from infra.bench.training_jobs import PLANS
    from model.config import SIZES
    from model.layer_errors import random_network
    from model.renderformer import count_parameters

    trained, points, workload = trained_scores(), [], workload_of(shop.effort)
    small = {f"table, {name}": config for name, config in PLANS["cpu"].sizes.items()}
    configs = small | {name: make() for name, make in SIZES.items()}
    timed_forward(forward_of(random_network(configs["smoke"]), workload), CPU)  # threads start
    for name, config in configs.items():
        if workload.resolution % config.picture_px:
            continue
        model = random_network(config)
        _, figures = timed_forward(forward_of(model, workload), CPU)
        scores = trained.get(name)
        further = {"M parameters": count_parameters(model) / 1e6}
        if scores:
            further |= {"psnr_log_db, median": scores.psnr_log_db, "steps": scores.steps}
        points.append(
            Point(
                setting=name,
                cost=figures["core_s"],
                error=scores.log_l1 if scores else None,
                default=name == shop.effort.network,
                further=further,
            )
        )
    return Curve(points=tuple(points), measured_on=_in_words(shop).split(" ", 1)[1])


@dataclass(frozen=True, kw_only=True)
class Trained:
    """What the trainings of one size came to on held-out pictures; means over seeds."""

    log_l1: float
    """Mean over the pictures."""
    psnr_log_db: float
    """Median over the pictures."""
    steps: float
    """Of each training."""


def trained_scores() -> dict[str, Trained]:
    """Return how the table's small trainings ended by size, on its largest set."""
    path = harness.RESULTS / "training_table.jsonl"
    lines = path.read_text().splitlines() if path.is_file() else []
    rows = [row for row in map(json.loads, lines) if row["change"] == "ours"]
    rows = [row for row in rows if row["plan"] == "cpu"]
    most = max((row["scenes"] for row in rows), default=0)
    largest = [row for row in rows if row["scenes"] == most]
    return {
        f"table, {size}": _means([row for row in largest if row["size"] == size])
        for size in {row["size"] for row in largest}
    }


def _means(rows: Sequence[Mapping[str, Any]]) -> Trained:
    return Trained(
        log_l1=float(np.mean([row["scores"]["log_l1"] for row in rows])),
        psnr_log_db=float(np.mean([row["scores"]["psnr_log_db_median"] for row in rows])),
        steps=float(np.mean([row["num_steps"] for row in rows])),
    )


_CORE_S = "core-seconds of the network"

KNOBS = (
    Knob(
        name="precision",
        title="Precision of the network",
        covers=("train.precision", "render.precision"),
        cost=_CORE_S,
        error="psnr_log_db, dB",
        better="higher",
        against="the same network in float32 (100 dB is the same picture)",
        because="float32, for references and small networks; bfloat16 from Base up, whose rounding "
        "is far below what any network gets wrong, trained ones too (Network: structure and "
        "precision). tf32 and float16 exist on CUDA only.",
        measure=measure_precision,
        needs=("torch",),
    ),
    Knob(
        name="attention",
        title="Attention",
        covers=(),
        cost="core-seconds of one attention layer",
        error="largest absolute error",
        better="lower",
        against="attention written out in float64, of normal numbers",
        because="torch's fused kernel in the precision of the network, without a mask: scenes of a "
        "batch are chosen of like length, and one scene alone has none.",
        measure=measure_attention,
        needs=("torch",),
    ),
    Knob(
        name="bundles",
        title="Empty ray bundles",
        covers=("render.skip_empty_bundles",),
        cost="core-seconds of the view stage",
        error="psnr_log_db, dB",
        better="higher",
        against="the same network with all bundles (100 dB is the same picture)",
        because="none skipped: bundles attend to each other, so that leaving out the empty ones "
        "changes what the others show, far more than the time that it saves is worth.",
        measure=measure_bundles,
        needs=("torch",),
    ),
    Knob(
        name="size",
        title="Size of the network",
        covers=(
            "train.model.width",
            "train.model.num_heads",
            "train.model.encoder_layers",
            "train.model.decoder_layers",
            "train.model.hidden_width",
            "train.model.head",
            "train.model.dpt_features",
            "train.model.dpt_channels",
            "train.model.dpt_taps",
        ),
        cost=_CORE_S,
        error="held-out log L1 of small trainings",
        better="lower",
        against="held-out pictures of the same set, after equally many views. Only the sizes of "
        "the table of small trainings were trained on one set for one number of steps. The others "
        'are n/a and show their cost alone: the shipped network (`smoke`, see "Training" above) '
        "was trained for longer, which would be read as a gain of its size, and larger ones were "
        "never trained",
        because="`base` where the paper is to be repeated, `smoke` on two cores. What a size is "
        "worth depends on the data: see the table of small trainings.",
        measure=measure_size,
        needs=("torch",),
    ),
)
