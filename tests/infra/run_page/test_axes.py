"""Axes hold their values, and ticks are round and on them."""

import pytest

from infra.run_page.axes import Axis, axis_of, short_number
from tests.for_each import case

VALUES: list[tuple[list[float], bool]] = [
    ([3.0], False),
    ([0.0], False),
    ([-2.0, 7.5], False),
    ([1e-6, 1e-2], True),
    ([0.03, 0.06], True),
]


def test_an_axis_holds_its_values_in_order_and_has_ticks() -> None:
    for values, log in VALUES:
        with case(values):
            axis = axis_of(values, log=log)
            places = [axis.place(value) for value in values]
            assert places == sorted(places) and 0 <= places[0] and places[-1] <= 1
            ticks = axis.ticks()
            assert 2 <= len(ticks) <= 10
            room = 1e-9 * (axis.high - axis.low)  # rounding
            assert all(axis.low - room <= tick <= axis.high + room for tick in ticks)


def test_equal_factors_are_equal_lengths_on_a_logarithmic_axis() -> None:
    axis = Axis(0.01, 1.0, log=True)
    # logarithms in float64
    assert axis.place(0.1) == pytest.approx(0.5, abs=1e-12)
    assert axis_of([0.0, 1.0], log=True).log is False, "0 has no place on one"
    assert axis_of([5.0, 9.0], from_zero=True).low == 0


def test_numbers_are_written_shortly() -> None:
    written = [short_number(v) for v in (0.034357, 120, 1500, 250_000, 2e6, 3e9, 9.5e-05, -1200)]
    assert written == ["0.0344", "120", "1.5k", "250k", "2M", "3G", "9.5e-05", "-1.2k"]
