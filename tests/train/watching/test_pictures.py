"""Which pictures of a run stay: the first, the last, and some between, evenly."""

import numpy as np

from train.watching.pictures import MOST_STEPS, dropped_steps


def test_few_stay_of_many_and_they_are_spread() -> None:
    kept: list[int] = []
    for step in range(60, 60 * 201, 60):
        kept.append(step)
        for dropped in dropped_steps(kept):
            kept.remove(dropped)
        assert len(kept) <= MOST_STEPS
        assert (kept[0], kept[-1]) == (60, step)
    gaps = np.diff(kept)
    assert gaps.max() < 2 * gaps.mean(), "no long time without a picture"
    assert dropped_steps([1, 2, 3]) == []
