"""What the processes of a training tell each other once a window, and who of them is slow."""

import json
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from train.loop.crew import Crew

OWN_PARTS = ("data", "forward", "backward", "device", "optimiser", "other")
"""Parts of a step that do not wait for another process. On a card `device` does, since the exchange
of gradients is the card's work: there only data and host tell a slow process."""

SLOW_FACTOR = 1.5
"""How much longer than the others, in the median, a process takes that is named."""

LEAST_LOST_S = 0.05
"""Seconds of a step that are worth naming."""


def told(crew: Crew, words: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return what each process says, by rank; all must call it."""
    return [json.loads(text) for text in crew.gather_text(json.dumps(words))]


def own_seconds(taken_s: Mapping[str, float], steps: int) -> float:
    """Return the time of a step that a process spent on its own work."""
    return sum(taken_s[part] for part in OWN_PARTS) / max(steps, 1)


def slowest(own_s: Sequence[float]) -> int | None:
    """Return the rank that all others wait for, or None where none stands out."""
    if len(own_s) < 2:
        return None
    worst = max(range(len(own_s)), key=own_s.__getitem__)
    others = statistics.median(value for rank, value in enumerate(own_s) if rank != worst)
    stands_out = own_s[worst] > SLOW_FACTOR * others and own_s[worst] - others > LEAST_LOST_S
    return worst if stands_out else None
