"""Equal error lies between the levels of plain Mitsuba, and both renderers are measured."""

from pathlib import Path

import pytest

from infra.bench.experiments.frontier import cost_at_error
from tests.infra.bench.bench_kit import measured_rows

LEVELS = [(float(1 << k), 2.0**k, 30 + 3.0 * k) for k in range(5)]
"""Samples, core-seconds and dB."""


def test_equal_error_lies_between_the_levels() -> None:
    for _, core_s, db in LEVELS:
        assert cost_at_error(LEVELS, db) == (core_s, True)
    core_s, is_reached = cost_at_error(LEVELS, 34.5)
    assert is_reached and core_s == pytest.approx(2**1.5, rel=0.1)
    assert cost_at_error(LEVELS, 50.0) == (LEVELS[-1][1], False)
    assert cost_at_error(LEVELS, 20.0) == (LEVELS[0][1], False)


@pytest.mark.slow("benchmarks")
def test_our_renderer_beside_plain_mitsuba(tmp_path: Path) -> None:
    found = measured_rows("frontier", tmp_path)
    db = {name: row.values["psnr_log_db, dB"] for name, row in found.items()}
    assert db["mitsuba 512"] > db["mitsuba 64"] > 20  # a picture of something else has below 20
    ours = found["trilight 46 dB"].values
    assert ours["Mitsuba's cost at equal error, times"] > 0
    assert 0 <= ours["log: over 1 dB worse than stated, %"] <= 100
    assert found["trilight 40 dB, 256 px"].on_front is None, "another width is no choice here"
