"""What stands out of recent steps, and what does not."""

import math
from dataclasses import replace

import numpy as np

from storage.seeds import rng_for
from train.loop.step import StepReport
from train.watching.spikes import LEAST_REMEMBERED, Spike, SpikeWatch, bound_of

REPORT = StepReport(loss=1.0, l1=1.0, brightness=1.0, grad_norm=0.1, applied=True)


def test_a_gradient_that_jumps_is_found_with_its_scenes_and_a_falling_loss_is_not() -> None:
    watch, rng = SpikeWatch(8.0), rng_for(0, "spikes")
    found = []
    for step in range(1, 401):
        noise = np.exp(rng.normal(0, 0.1, 2))
        grad_norm = 5.0 if step == 300 else 0.1 * noise[0]
        loss = noise[1] / math.sqrt(step)
        report = replace(REPORT, loss=float(loss), grad_norm=float(grad_norm))
        found += watch.add(step, report, ["a", f"b{step}"])
    (spike,) = found
    assert (spike.step, spike.what, spike.value, spike.keys) == (
        300,
        "grad_norm",
        5.0,
        ("a", "b300"),
    )
    # 8 deviations of 10 % above the median of 0.1; a median of 200 is sure to some per cent
    assert 0.15 < spike.bound < 0.2


def test_the_bound_is_median_and_deviations_in_a_case_by_hand() -> None:
    values = [1.0, 2.0, 3.0, 4.0, 100.0] * 20
    assert bound_of(values, 2.0) == 3.0 + 2 * 1.4826 * 1.0
    assert bound_of(values[: LEAST_REMEMBERED - 1], 2.0) is None


def test_what_hardly_moves_does_not_spike_at_a_breath_and_what_is_not_finite_never() -> None:
    watch = SpikeWatch(8.0)
    for step in range(100):
        assert watch.add(step, REPORT, []) == []
    assert watch.add(100, replace(REPORT, loss=1.1), []) == []
    assert watch.add(101, replace(REPORT, loss=math.nan, grad_norm=math.inf), []) == []
    assert watch.add(102, replace(REPORT, loss=1.5), ["k"]) == [
        Spike(step=102, what="loss", value=1.5, bound=1.16, keys=("k",))
    ]
