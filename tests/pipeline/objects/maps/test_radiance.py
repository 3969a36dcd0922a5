"""Maps from outside: no light is lost by resampling, and what is wrong says so."""

import numpy as np
import pytest

from pipeline.objects.maps.radiance import usable_map
from pipeline.objects.maps.resample import area_means, flux, solid_angle_means
from storage.errors import Rejected
from tests.for_each import for_each
from tests.pipeline.objects.maps.map_files import sun_map


@for_each("height", [1, 5, 13, 32, 48])
def test_a_sun_of_a_million_keeps_its_energy(height: int) -> None:
    radiance = sun_map(rows=48)
    found = solid_angle_means(radiance, height)
    assert found.shape == (height, 2 * height, 3)
    np.testing.assert_allclose(flux(found), flux(radiance), rtol=1e-12)  # sums in float64
    if height == 48:
        np.testing.assert_allclose(found, radiance, rtol=1e-12)


def test_means_are_those_of_the_overlaps() -> None:
    """Against a slow twin that cuts both grids into a common one."""
    values = np.random.default_rng(0).random((6, 4, 2))
    fine = np.repeat(np.repeat(values, 10, axis=0), 9, axis=1)  # 60 x 36
    twin = fine.reshape(4, 15, 3, 12, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(area_means(values, 4, 3), twin, rtol=1e-12)


def test_a_constant_map_stays_constant_and_a_small_one_as_it_is() -> None:
    ones = np.ones((7, 14, 3), np.float32)
    np.testing.assert_allclose(solid_angle_means(ones, 3), 1, rtol=1e-12)
    assert usable_map(ones, 64).shape == ones.shape


def test_what_is_wrong_with_a_map_is_said() -> None:
    def wrong(**changes: float) -> np.ndarray:
        radiance = np.ones((4, 8, 3), np.float32)
        radiance[1, 2] = changes["value"]
        return radiance

    cases = {
        "not_a_number": wrong(value=np.nan),
        "infinite_radiance": wrong(value=np.inf),
        "negative_radiance": wrong(value=-1.0),
        "too_bright": wrong(value=2e9),
        "black_map": np.zeros((4, 8, 3), np.float32),
        "not_two_to_one": np.ones((1, 1, 3), np.float32),
    }
    for reason, radiance in cases.items():
        with pytest.raises(Rejected) as found:
            usable_map(radiance, 16)
        assert found.value.reason == reason
    with pytest.raises(Rejected, match="row 1, column 2"):
        usable_map(cases["not_a_number"], 16)
    with pytest.raises(Rejected) as found:
        usable_map(-np.ones((4, 8, 3), np.float32), 16)
    assert found.value.reason == "negative_radiance"


def test_slightly_negative_values_become_black() -> None:
    radiance = np.ones((4, 8, 3), np.float32)
    radiance[2, 3, 1] = -1e-3
    found = usable_map(radiance, 16)
    assert found.min() == 0 and (found == np.maximum(radiance, 0)).all()
