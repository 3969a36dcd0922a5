"""The network: its precision, its attention.

But for `trained-precision` weights are random, since costs do not depend on them. Errors do.
"""

import copy
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Point, TurnFigures, repeats
from infra.bench.experiments.sampling import DB, WORST, scenes
from infra.bench.workshop import Workshop

if TYPE_CHECKING:
    from torch import Tensor

PRECISIONS = ("float32", "bfloat16")
ATTENTION = ("fused", "fused, bfloat16", "fused, with a mask", "torch's own products")


def _bright(workshop: Workshop) -> Any:
    from infra.bench.sides.networks import bright_network
    from model.config import SIZES

    return workshop.kept("bright", lambda: bright_network(SIZES[workshop.effort.network]()))


def _measure_precision(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    """Measure a whole pass in each precision that a processor has."""
    from infra.bench.sides.networks import (
        CPU,
        forward_of,
        log10_psnr_db,
        timed_forward,
        workload_of,
    )
    from model.precision import set_precision

    workload, exact = workload_of(workshop.effort), None
    for point in points:
        model = workshop.kept(
            ("precision", point.name),
            lambda name=point.name: set_precision(copy.deepcopy(_bright(workshop)), name),  # type: ignore[misc]
        )
        picture, figures = timed_forward(forward_of(model, workload), CPU)
        exact = picture if exact is None else exact
        yield point.name, {**figures, "db": log10_psnr_db(picture, exact)}


def _measure_trained(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    """Render a built-in scene by the network that is asked for, in each precision."""
    from model.neural_renderer import NeuralRenderer

    subject, exact = workshop.subject(turn), None
    for point in points:
        renderer = workshop.kept(
            ("trained", point.name),
            lambda name=point.name: NeuralRenderer.load(  # type: ignore[misc]
                workshop.asked.network, device="cpu", precision=name
            ),
        )
        px = min(renderer.trained.resolution or 64, workshop.effort.resolution)
        began = time.process_time()
        picture = renderer.render(subject.scene, resolution=px)[0]
        core_s = time.process_time() - began
        exact = picture if exact is None else exact
        yield point.name, {"core_s": core_s, "db": _db(picture, exact)}


def _db(picture: Any, exact: Any) -> float:
    from storage.metrics import psnr_log_db

    return psnr_log_db(picture, exact)


def _measure_attention(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    """Measure one attention layer of the encoder, several ways, on the same normal numbers."""
    from infra.bench.sides.networks import CPU, timed_forward

    ways, exact = workshop.kept("attention", lambda: _attention(workshop.effort))
    for point in points:
        output, figures = timed_forward(ways[point.name], CPU)
        yield point.name, {**figures, "error": float((output.double() - exact).abs().max())}


def _attention(effort: Effort) -> "tuple[dict[str, Callable[[], Tensor]], Tensor]":
    """Return the ways to attend, and the answer written out in float64."""
    import torch
    from torch.nn.attention import SDPBackend, sdpa_kernel

    from model.attention import attend
    from model.config import SIZES

    config = SIZES[effort.network]()
    tokens = config.num_registers + effort.network_triangles
    shape = (3, 1, config.num_heads, tokens, config.head_width)
    q, k, v = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    rounded = (q.bfloat16(), k.bfloat16(), v.bfloat16())
    every_key = torch.ones(1, tokens, dtype=torch.bool)

    def plain() -> "Tensor":
        with sdpa_kernel(SDPBackend.MATH):
            return attend(q, k, v, None)

    ways: dict[str, Callable[[], Tensor]] = dict(
        zip(
            ATTENTION,
            (
                lambda: attend(q, k, v, None),
                lambda: attend(*rounded, None),
                lambda: attend(q, k, v, every_key),
                plain,
            ),
            strict=True,
        )
    )
    scores = q.double() @ k.double().transpose(-1, -2) / config.head_width**0.5
    return ways, scores.softmax(dim=-1) @ v.double()


CORE_S = Column(name="core-seconds of the network", figure="core_s")
_PRECISION_POINTS = [Point(name=name, default=name == PRECISIONS[0]) for name in PRECISIONS]
_of_pictures = partial(Experiment, error=DB, better="higher", needs=("torch",))
"""Declares an experiment on pictures of the network."""

EXPERIMENTS = (
    _of_pictures(
        name="precision",
        title="Precision of the network",
        about="One view of a full scene by Base with random weights, on a processor.",
        covers=("train.precision", "render.precision"),
        cost=CORE_S,
        against="the same network in float32 (100 dB is the same picture)",
        because=(
            "Default: float32, for references and small networks; bfloat16 from Base up, where "
            "its rounding is far below the error of any network, trained ones included. tf32 "
            "and float16 exist on CUDA only."
        ),
        points=lambda effort: _PRECISION_POINTS,
        turns=repeats,
        measure=_measure_precision,
        warm_up=True,
    ),
    _of_pictures(
        name="trained-precision",
        title="Precision of a trained network",
        about="Built-in scenes by the shipped network, or by `--checkpoint`, at the width that it "
        "was trained on.",
        cost=CORE_S,
        against="the same network in float32; median over the scenes",
        columns=(WORST,),
        points=lambda effort: _PRECISION_POINTS,
        turns=scenes,
        measure=_measure_trained,
        warm_up=True,
    ),
    Experiment(
        name="attention",
        title="Attention",
        about="One attention layer of the encoder over the tokens of a full scene.",
        cost=Column(name="core-seconds of one attention layer", figure="core_s"),
        error=Column(name="largest absolute error", figure="error"),
        against="attention written out in float64, of normal numbers",
        because=(
            "Default: torch's fused kernel in the precision of the network, without a mask. "
            "Scenes of a batch are chosen of similar length, and a single scene needs no mask."
        ),
        points=lambda effort: [Point(name=name, default=name == "fused") for name in ATTENTION],
        turns=repeats,
        measure=_measure_attention,
        warm_up=True,
        needs=("torch",),
    ),
)
