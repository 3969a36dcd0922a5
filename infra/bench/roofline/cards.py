"""Cards by their data sheets, and what share of it programs reach: the only figures taken on trust.

Nothing here was measured by this project. Shares are what public measurements of the libraries'
kernels report for products and attention of the sizes of these networks, rounded down.
"""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Card:
    """One card: rates per second, and bytes."""

    name: str
    """What tables call it."""
    memory_gib: int
    """Memory, GiB."""
    bandwidth: float
    """Bytes a second from and to memory, by the data sheet."""
    bfloat16: float
    """FLOPs a second of bfloat16 products, dense, by the data sheet: the peak."""
    tf32: float
    """The same of TF32."""
    float32: float
    """The same of float32 without TF32."""


CARDS = {
    card.name: card
    for card in (
        Card(
            name="A100-40",
            memory_gib=40,
            bandwidth=1.555e12,
            bfloat16=312e12,
            tf32=156e12,
            float32=19.5e12,
        ),
        Card(
            name="H100-80",
            memory_gib=80,
            bandwidth=3.35e12,
            bfloat16=989e12,
            tf32=494e12,
            float32=67e12,
        ),
        Card(
            name="H200-141",
            memory_gib=141,
            bandwidth=4.8e12,
            bfloat16=989e12,
            tf32=494e12,
            float32=67e12,
        ),
    )
}
"""The cards of the tables, by name."""

BANDWIDTH_SHARE = 0.8
"""Share of the bandwidth that kernels of one pass over memory reach."""

PRODUCT_SHARE = {"bfloat16": 0.65, "tf32": 0.5, "float32": 0.7}
"""Share of the peak that products and convolutions reach, by what they multiply in."""

ATTENTION_SHARE = {
    ("flash", "forward"): 0.40,
    ("flash", "backward"): 0.30,
    ("packed", "forward"): 0.32,
    ("packed", "backward"): 0.24,
    ("masked", "forward"): 0.20,
    ("masked", "backward"): 0.12,
}
"""Share of the bfloat16 peak that attention reaches: flash, flash on packed sequences, and the
memory-efficient kernel, which torch takes where there is a mask or float32."""

LAUNCH_S = 4e-6
"""Least time of a kernel, however little it does."""

FOREACH_ELEMENTS = 320 * 65_536
"""Elements that one launch of torch's kernels over lists of tensors takes on."""
