"""The interval of a mean: clusters count, not their members."""

import numpy as np
import pytest

from storage.intervals import mean_interval


def test_the_interval_of_a_mean_goes_by_clusters() -> None:
    """Ten scenes of which each has the same figure 8 times know no more than ten figures."""
    figures = [float(scene < 3) for scene in range(10) for _ in range(8)]
    clusters = [f"scene {scene}" for scene in range(10) for _ in range(8)]
    low, high = mean_interval(figures, clusters)
    alone_low, alone_high = mean_interval(figures, [str(n) for n in range(80)])
    assert low < alone_low < 0.3 < alone_high < high
    assert low == pytest.approx(0.3 - 1.96 * np.sqrt(0.3 * 0.7 / 10), abs=0.06)
    assert mean_interval([0.5] * 4, ["a", "a", "b", "b"]) == (0.5, 0.5)
