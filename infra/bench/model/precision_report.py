"""The errors of a network's parts in few bits: what is kept, and the table for people."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from infra.bench.harness import Result

MARK = "precision-parts"
AS_CHOSEN = "bfloat16, as chosen by `set_precision`"
EMULATED = "bfloat16, the same parts rounded by hooks"
"""Not quite the same: sums and products inside a layer stay float32 here."""


@dataclass(frozen=True, kw_only=True)
class Decibels:
    """psnr_log_db over the views."""

    median: float
    """What to quote."""
    worst: float
    """The smallest."""


@dataclass(frozen=True, kw_only=True)
class PartErrors:
    """What rounding one part to bfloat16 does to the pictures."""

    part: str
    """Its name."""
    narrow: bool
    """Whether `set_precision` rounds it."""
    alone: Decibels
    """All else float32."""
    reversed_choice: Decibels
    """The usual parts rounded but this one, or, where it is none of them, this one as well."""
    alone_in_random_weights: Decibels
    """As `alone`, in a network of the same configuration that was not trained."""


@dataclass(frozen=True, kw_only=True)
class PrecisionParts(Result):
    """The errors of one network; all against the same network in float32 unless said otherwise."""

    network: str
    """Which one."""
    dataset: str
    """Where its scenes are from."""
    scenes: int
    """How many."""
    views: int
    """Of all scenes together."""
    resolution: int
    """Pixels across."""
    own_error: Decibels
    """Of the network in float32 to the path-traced pictures."""
    own_error_in_bfloat16: Decibels
    """The same in bfloat16."""
    wholes: Mapping[str, Decibels]
    """Of parts that are rounded together, by name; AS_CHOSEN and EMULATED are among them."""
    random_bfloat16: Decibels
    """In bfloat16 as chosen, of the configuration with random weights to itself."""
    parts: tuple[PartErrors, ...]
    """One by one."""


def decibels(values: Sequence[float]) -> Decibels:
    """Return median and worst."""
    return Decibels(median=float(np.median(values)), worst=float(min(values)))


def lines(result: PrecisionParts) -> list[str]:
    """Return the result as Markdown: the network whole, then its parts, the most harmful first."""
    head = (
        f"{result.network}: {result.scenes} scenes ({result.views} views of {result.resolution} x "
        f"{result.resolution}) of {result.dataset}, psnr_log_db to the same network in float32, "
        f"median / worst view (`python -m infra.bench.model.precision_parts`, {result.date}):"
    )
    wholes = [f"| {name} | {_shown(found)} |" for name, found in result.wholes.items()]
    parts = sorted(result.parts, key=lambda one: one.alone.median)
    return [
        head,
        "",
        "| rounded together | dB |",
        "|---|---|",
        *wholes,
        f"| bfloat16, as chosen, the same configuration with random weights | "
        f"{_shown(result.random_bfloat16)} |",
        "",
        f"To the path-traced pictures the network has {_shown(result.own_error, 2)} dB in float32 "
        f"and {_shown(result.own_error_in_bfloat16, 2)} dB in bfloat16.",
        "",
        f"| part | alone in bfloat16, dB | the same parts ({_shown(result.wholes[EMULATED])}), but "
        "this one | random weights, alone |",
        "|---|---|---|---|",
        *(_row(one) for one in parts),
    ]


def _row(one: PartErrors) -> str:
    choice = "in float32" if one.narrow else "rounded too"
    name = one.part if one.narrow else f"**{one.part}**"
    return (
        f"| {name} | {_shown(one.alone)} | {choice}: {_shown(one.reversed_choice)} | "
        f"{_shown(one.alone_in_random_weights)} |"
    )


def _shown(found: Decibels, digits: int = 1) -> str:
    return f"{found.median:.{digits}f} / {found.worst:.{digits}f}"
