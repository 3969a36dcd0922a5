"""Exponents of growth are those of what grows."""

import pytest

from infra.bench.growth import fitted_exponent, is_steady
from tests.for_each import case

SIZES = (100, 1_000, 10_000, 250_000)


def test_the_exponent_is_found_beside_a_fixed_cost() -> None:
    for fixed in [0.0, 3.0]:
        for power in [-1.0, 0.5, 1.0, 2.0]:
            with case((fixed, power)):
                costs = [fixed + 5.0 * (size / 100) ** power for size in SIZES]
                assert fitted_exponent(SIZES, costs) == pytest.approx(power, abs=0.02)


def test_few_sizes_and_no_growth() -> None:
    assert fitted_exponent(SIZES, (1.0, 1.2, 0.9, 1.1)) == 0.0
    assert fitted_exponent((10, 1_000), (2.0, 20.0)) == pytest.approx(0.5)


def test_what_falls_and_grows_again_has_no_exponent() -> None:
    assert is_steady((1.0, 2.0, 2.0)) and is_steady((3.0, 1.0))
    assert not is_steady((256.0, 119.0, 147.0))
