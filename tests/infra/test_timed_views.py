"""What a first and a further view take, by a clock that only loading and showing move."""

import time

import numpy as np
import pytest

from infra.timed_views import Show, timed_views


def test_the_first_view_pays_for_loading_and_the_round_that_warms_up_counts_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [0.0]
    loaded = [100.0, 3.0, 5.0, 4.0]
    monkeypatch.setattr(time, "process_time", lambda: now[0])

    def load() -> Show:
        now[0] += loaded.pop(0)

        def show() -> np.ndarray:
            now[0] += 1.0
            return np.full((2, 2, 3), now[0], np.float32)

        return show

    found = timed_views(load, repeats=3)
    assert not loaded
    assert (found.first_s, found.further_s) == (5.0, 1.0)  # the median of 3, 5 and 4, and a view
    assert found.radiance_rgb[0, 0, 0] == now[0], "the last picture"
