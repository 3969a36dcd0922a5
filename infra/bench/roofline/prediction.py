"""Kernels -> time on a card: each takes the longest of its launch, its bytes and its products.

Kernels follow each other without a gap, and the host is always in time: for kernels of 4 us and
more that is so where it has nothing else to do.
"""

from collections import Counter
from dataclasses import dataclass

from infra.bench.roofline.cards import (
    ATTENTION_SHARE,
    BANDWIDTH_SHARE,
    LAUNCH_S,
    PRODUCT_SHARE,
    Card,
)
from infra.bench.roofline.trace import Kernel, Traced

TF32_PARTS = ("LPIPS", "head")
"""Parts whose float32 convolutions torch computes in TF32, its default. The network forbids it, but
in its own way forward while it trains in bfloat16."""


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """What a step takes on a card."""

    kernels: int
    """Kernels that are launched."""
    casts: int
    """Those of them that only convert."""
    gigabytes: float
    """Bytes from and to memory."""
    teraflops: float
    """Products, convolutions and attention, as torch's FlopCounterMode counts them."""
    milliseconds: float
    """Time of the card."""
    by_kind_ms: dict[str, float]
    """The same by what limits the kernels (trace.Kind)."""
    by_part_ms: dict[str, float]
    """The same by part of the computation."""
    pointwise_share: float
    """Share of the time that casts, norms and everything elementwise take."""
    peak_share: float
    """FLOPs a second over the card's peak in bfloat16."""
    peak_gib: float
    """Most memory that is held at once, GiB; workspaces of libraries are not in it."""
    waits: int
    """How often the host waits for the card in a step."""
    window_waits: int
    """How often it does once a window of steps, to learn what they did."""


def predicted(traced: Traced, card: Card) -> Prediction:
    """Return what a step takes on a card."""
    by_kind, by_part = Counter[str](), Counter[str]()
    for kernel in traced.kernels:
        seconds = kernel_s(kernel, card)
        by_kind[kernel.kind] += seconds  # type: ignore[assignment]
        by_part[kernel.part[0] or "other"] += seconds  # type: ignore[assignment]
    total_s, flops = sum(by_kind.values()), sum(kernel.flops for kernel in traced.kernels)
    return Prediction(
        kernels=sum(kernel.launches for kernel in traced.kernels),
        casts=sum(kernel.launches for kernel in traced.kernels if kernel.kind == "cast"),
        gigabytes=sum(kernel.num_bytes for kernel in traced.kernels) / 1e9,
        teraflops=flops / 1e12,
        milliseconds=1e3 * total_s,
        by_kind_ms={kind: 1e3 * seconds for kind, seconds in by_kind.items()},
        by_part_ms={part: 1e3 * seconds for part, seconds in by_part.items()},
        pointwise_share=(by_kind["cast"] + by_kind["pointwise"]) / total_s,
        peak_share=flops / total_s / card.bfloat16,
        peak_gib=peak_bytes(traced) / 2**30,
        waits=traced.waits,
        window_waits=traced.window_waits,
    )


def kernel_s(kernel: Kernel, card: Card) -> float:
    """Return the seconds of one kernel."""
    least = LAUNCH_S * kernel.launches
    memory = kernel.num_bytes / (BANDWIDTH_SHARE * card.bandwidth)
    return max(least, memory, kernel.flops / _rate(kernel, card) if kernel.flops else 0.0)


def _rate(kernel: Kernel, card: Card) -> float:
    if kernel.kind == "attention":
        which = "masked" if "efficient" in kernel.name else "flash"
        which = "packed" if "varlen" in kernel.name else which
        way = "backward" if "backward" in kernel.name else "forward"
        return ATTENTION_SHARE[which, way] * card.bfloat16
    if kernel.product_type in ("bfloat16", "float16"):
        return PRODUCT_SHARE["bfloat16"] * card.bfloat16
    if kernel.kind == "convolution" and kernel.part[0] in TF32_PARTS:
        return PRODUCT_SHARE["tf32"] * card.tf32
    return PRODUCT_SHARE["float32"] * card.float32


def peak_bytes(traced: Traced) -> int:
    """Return the most bytes that are held at once."""
    changes = Counter[tuple[int, int]]()
    for storage, (index, size) in traced.born.items():
        changes[index, 1] += size
        if storage in traced.died:
            changes[traced.died[storage], 0] -= size  # given back before the next is taken
    held = most = 0
    for _, change in sorted(changes.items()):
        held += change
        most = max(most, held)
    return most
