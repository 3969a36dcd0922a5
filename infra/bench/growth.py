"""How a cost grows with a size: the exponent of a power law beside a fixed cost."""

from collections.abc import Sequence

import numpy as np

_STEPS = np.concatenate([np.arange(-1.5, -0.04, 0.01), np.arange(0.05, 3.001, 0.01)])
"""Exponents that are tried."""
_FLAT = 1.5
"""Costs whose largest is less than this many times their smallest neither grow nor fall."""


def fitted_exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Return p of the costs c + a size^p that fit best, relative errors counting; c, a >= 0.

    0 where the costs do not grow or fall. Of two sizes c is taken as 0.

    Args:
        sizes: rising, two at least.
        costs: above 0.
    """
    size, cost = np.asarray(sizes, np.float64), np.asarray(costs, np.float64)
    if cost.max() < _FLAT * cost.min():
        return 0.0
    if len(size) == 2:
        return float(np.diff(np.log(cost))[0] / np.diff(np.log(size))[0])
    return float(min(_STEPS, key=lambda power: _misfit(size / size[-1], cost, power)))


def is_steady(costs: Sequence[float]) -> bool:
    """Return whether costs only grow or only fall: of others no exponent says anything."""
    steps = np.diff(np.asarray(costs, np.float64))
    return bool((steps >= 0).all() or (steps <= 0).all())


def _misfit(size: np.ndarray, cost: np.ndarray, power: float) -> float:
    rows = np.stack([np.ones_like(size), size**power], axis=1) / cost[:, None]
    best, *_ = np.linalg.lstsq(rows, np.ones_like(cost), rcond=None)
    if best.min() < 0:  # without the term that would be negative
        column = rows[:, [int(np.argmax(best))]]
        best, *_ = np.linalg.lstsq(column, np.ones_like(cost), rcond=None)
        return float(np.sum((column @ best - 1) ** 2))
    return float(np.sum((rows @ best - 1) ** 2))
