"""Confidence interval of a mean of clustered figures, such as the views of one scene."""

from collections.abc import Sequence

import numpy as np


def mean_interval(figures: Sequence[float], clusters: Sequence[str]) -> tuple[float, float]:
    """Return the 95 % interval of a mean whose figures are alike within clusters.

    It is bootstrapped over whole clusters (2000 times, of a fixed seed).

    Args:
        figures: one for each turn.
        clusters: the name of each turn's cluster.
    """
    names = sorted(set(clusters))
    rows = np.array([names.index(name) for name in clusters])
    sums = np.bincount(rows, weights=np.asarray(figures, np.float64))
    counts = np.bincount(rows)
    drawn = np.random.default_rng(0).integers(len(names), size=(2000, len(names)))
    means = sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)
