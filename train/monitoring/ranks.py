"""Statistics that processes exchange once a window, and detection of a slow process."""

import json
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from train.loop.distributed import DistributedContext

OWN_PHASES = ("data", "forward", "backward", "device", "optimiser", "other")
"""Phases that do not wait for another process. On a GPU `device` does, since the exchange of
gradients is the GPU's work: there only `data` and host time reveal a slow process."""

SLOW_FACTOR = 1.5
"""Multiple of the others' median time from which a process counts as slow."""

LEAST_LOST_S = 0.05
"""Minimum seconds per step that a slow process costs before it is reported."""


def exchange_values(
    dist_context: DistributedContext, values: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Return the values of each process, by rank; all must call it."""
    return [json.loads(text) for text in dist_context.gather_text(json.dumps(values))]


def own_seconds(taken_s: Mapping[str, float], steps: int) -> float:
    """Return the seconds per step that a process spent on its own work."""
    return sum(taken_s[part] for part in OWN_PHASES) / max(steps, 1)


def slowest_rank(own_s: Sequence[float]) -> int | None:
    """Return the rank that all others wait for, or None if no process is slow."""
    if len(own_s) < 2:
        return None
    worst = max(range(len(own_s)), key=own_s.__getitem__)
    typical_s = statistics.median(value for rank, value in enumerate(own_s) if rank != worst)
    stands_out = own_s[worst] > SLOW_FACTOR * typical_s and own_s[worst] - typical_s > LEAST_LOST_S
    return worst if stands_out else None
