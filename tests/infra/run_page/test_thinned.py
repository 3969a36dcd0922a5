"""Thinning keeps means and extremes."""

import numpy as np
import pytest

from infra.run_page.thinned import MOST_POINTS, thinned
from storage.seeds import rng_for
from tests.for_each import case


def test_a_curve_becomes_short_and_loses_no_spike() -> None:
    for count in [0, 1, MOST_POINTS, 50_001]:
        with case(count):
            values = rng_for(0, "curve").normal(size=count)
            found = thinned([(step, float(value)) for step, value in enumerate(values)])
            assert len(found) <= MOST_POINTS
            if count:
                assert found[-1].step == count - 1
                assert max(point.high for point in found) == values.max()
                assert min(point.low for point in found) == values.min()
                size = -(-count // MOST_POINTS)
                # means in another order
                assert found[0].mean == pytest.approx(np.mean(values[:size]), abs=1e-12)
