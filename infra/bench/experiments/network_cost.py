"""Our network beside the published forward pass, on the same weights; and how its cost grows.

A graphics card is used where there is one; there the clock counts, on a processor core-seconds.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from infra.bench.effort import Effort
from infra.bench.experiment import (
    Column,
    Experiment,
    Figures,
    Point,
    TurnFigures,
    one_by_one,
    repeats,
)
from infra.bench.workshop import Workshop

if TYPE_CHECKING:
    import torch

    from model.costs import Workload

PUBLISHED, EQUAL, DEFAULT = SIDES = ("published", "float32", "bfloat16")
CASES: Mapping[int, Mapping[str, int]] = {
    256: {"full": 1536, "median": 1434, "plane-only": 140},
    512: {"full": 4096, "median": 2462, "plane-only": 140},
}
"""Triangles by resolution; the median is that of 200 composed scenes of `pretrain-256` and of
`finetune-512`."""
_PRODUCTS = 20


def device() -> "torch.device":
    """Return the graphics card where there is one."""
    import torch

    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def _workload(size: tuple[int, int, int]) -> "Workload":
    from model.costs import Workload

    triangles, views, resolution = size
    return Workload(triangles=triangles, views=views, resolution=resolution)


def _cases(effort: Effort) -> list[Point]:
    """Return every side of every case: scene, views and width of the picture."""
    px = effort.network_px
    widths = (px, 2 * px) if effort.name == "careful" else (px,)
    chosen = {px: CASES.get(px, {"full": effort.network_triangles}) for px in widths}
    return [
        Point(
            name=f"{px} px, {views} view{'s' if views > 1 else ''}, {scene}: {side}",
            settings=(side, (triangles, views, px)),
        )
        for px, scenes in chosen.items()
        for views in (1, 4)
        for scene, triangles in scenes.items()
        for side in SIDES
    ]


def _growth(effort: Effort) -> list[Point]:
    """Return our sides along triangles, views and pixels, one at a time."""
    triangles, px = effort.network_triangles, effort.network_px
    doubled = [512 << step for step in range(effort.growth + 2)]
    sizes = [
        *((count, 1, px) for count in doubled),
        *((triangles, 1 << step, px) for step in range(effort.growth + 1)),
        *((triangles, 1, width) for width in (px // 2, px, 2 * px)),
    ]
    return [
        Point(name=f"{t} triangles, {v} views, {p} px: {side}", settings=(side, (t, v, p)))
        for t, v, p in dict.fromkeys(sizes)
        for side in (EQUAL, DEFAULT)
    ]


def _contenders(workshop: Workshop) -> Any:
    from infra.bench.sides.networks import Contenders
    from model.published.config import decode_published

    return workshop.kept("contenders", lambda: Contenders(decode_published({}), SIDES, device()))


def _measure(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    """Measure time, memory and, within a case, the difference to the sides before it."""
    from infra.bench.sides.networks import log10_psnr_db, published_like, timed_forward

    pictures: dict[Any, Any] = {}
    for point in points:
        side, size = point.settings
        forward = _contenders(workshop).prepared(side, _workload(size))
        picture, figures = timed_forward(forward, device())
        pictures[side, size] = picture.cpu()
        figures["memory_mb"] = _peaks(workshop, points, side)[size] / 1e6
        published, equal = pictures.get((PUBLISHED, size)), pictures.get((EQUAL, size))
        if side == EQUAL and published is not None:
            figures["difference"] = float((published_like(picture.cpu()) - published).abs().max())
        if side == DEFAULT and equal is not None:
            figures["db"] = log10_psnr_db(picture.cpu(), equal)
        yield point.name, figures


def _peaks(workshop: Workshop, points: Sequence[Point], side: str) -> dict[Any, int]:
    """Return the peak memory of a side by size, measured once in a process of its own."""
    from infra.bench.sides.network_memory import peaks_of
    from model.published.config import decode_published

    def measured() -> dict[Any, int]:
        sizes = [point.settings[1] for point in points if point.settings[0] == side]
        workloads = [_workload(size) for size in sizes]
        return dict(
            zip(sizes, peaks_of(side, decode_published({}), workloads, device()), strict=True)
        )

    return workshop.kept(("peaks", side), measured)


def _product(workshop: Workshop, point: Point, turn: str) -> Figures:
    """Multiply what the network is made of: tokens by its hidden layer."""
    import torch

    from infra.bench.sides.networks import timed_forward
    from model.config import base

    config, on = base(), device()
    x = torch.ones(1536, config.width, dtype=getattr(torch, point.name), device=on)
    weight = torch.ones(config.hidden_width, config.width, dtype=x.dtype, device=on)

    def products() -> torch.Tensor:
        for _ in range(_PRODUCTS):
            found = torch.nn.functional.linear(x, weight)
        return found

    _, figures = timed_forward(products, on)
    gflop = 2e-9 * _PRODUCTS * 1536 * config.width * config.hidden_width
    return {**figures, "gflop": gflop}


_SECONDS = Column(name="core-seconds", figure="core_s")
_MEMORY = Column(name="MB beyond the weights", figure="memory_mb")
_of_passes = partial(Experiment, cost=_SECONDS, needs=("torch",))
"""Declares an experiment on the time of forward passes."""

EXPERIMENTS = (
    _of_passes(
        name="network-cases",
        title="Our network beside the published forward pass",
        about="Base with the same random weights: the published operations (float32, whole "
        "textures, padded, views together) beside ours in float32 and bfloat16.",
        columns=(
            _MEMORY,
            Column(name="float32 differs from published by", figure="difference", over="most"),
            Column(name="bfloat16 to float32, psnr_log_db", figure="db"),
        ),
        points=_cases,
        turns=repeats,
        measure=_measure,
        warm_up=True,
    ),
    _of_passes(
        name="network-growth",
        title="How the network's cost grows",
        about="Base with random weights; triangles, views and pixels grow one at a time.",
        columns=(_MEMORY,),
        points=_growth,
        turns=lambda effort: ["round 1"],  # neighbours on a curve bear each other out
        measure=_measure,
    ),
    _of_passes(
        name="matmul",
        title="What bfloat16 gives this machine's products of matrices",
        about="1536 tokens by the hidden layer of Base, as the network's layers are.",
        columns=(Column(name="GFLOP", figure="gflop"),),
        points=lambda effort: [Point(name=EQUAL, default=True), Point(name=DEFAULT)],
        turns=repeats,
        measure=one_by_one(_product),
        warm_up=True,
    ),
)
