"""One line of the table of what a set left out, and the FLOPs that several of them count."""

from dataclasses import dataclass

from model.config import base
from model.costs import Workload, flops


@dataclass(frozen=True, kw_only=True)
class Line:
    """One part of a scene."""

    part: str
    """What it is."""
    everything: str
    """What it would take with nothing left out."""
    kept: str
    """What it takes."""
    factor: float
    """How many times less."""
    error: str
    """What leaving it out adds."""


def base_flops(triangles: int, views: int, px: int) -> int:
    """Return the FLOPs of Base for a scene of so many triangles and square views of `px` pixels."""
    workload = Workload(triangles=triangles, views=views, resolution=px)
    return sum(flops(base(), workload).values())
