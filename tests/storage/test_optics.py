"""Lobes: the tables of energy compensation and albedos, beside closed forms and slow twins."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from storage import optics
from storage.optics import (
    ROUGHNESS_STEPS,
    X_STEPS,
    Smith,
    albedo_table,
    constant_albedos,
    directional_albedo,
    mean_albedo,
    scattered_again,
)
from tests.for_each import for_each

SMITHS: list[Smith] = ["correlated", "separable"]


def slow_albedo(cos_in: float, alpha: float, smith: Smith) -> float:
    """E by drawing facets by D cos, a million of them on a grid: another parametrisation."""
    share = (np.arange(2000) + 0.5) / 2000
    tangent = alpha * np.sqrt(share / (1 - share))
    phi = (np.arange(500) + 0.5) * np.pi / 500
    sine = np.sqrt(1 - cos_in**2)
    cosine = 1 / np.sqrt(1 + tangent**2)
    projected = (tangent * cosine)[:, None] * np.cos(phi) * sine + (cosine * cos_in)[:, None]
    cos_out = 2 * projected * cosine[:, None] - cos_in
    useful = (projected > 0) & (cos_out > 0)
    cos_out = np.where(useful, np.minimum(cos_out, 1), 1.0)
    masked_in, masked_out = _masked(np.array(cos_in), alpha), _masked(cos_out, alpha)
    both = masked_in * masked_out if smith == "separable" else 0.0
    weight = projected / (cos_in * cosine[:, None] * (1 + masked_in + masked_out + both))
    return float(np.where(useful, weight, 0).mean())


def _masked(cosine: NDArray, alpha: float) -> NDArray:
    return (np.sqrt(1 + alpha**2 * (1 / cosine**2 - 1)) - 1) / 2


def stretched(cosine: NDArray, alpha: NDArray) -> NDArray[np.float64]:
    length: NDArray[np.float64] = np.sqrt(cosine**2 + np.square(alpha) * (1 - cosine**2))
    return cosine / length


@for_each("smith", SMITHS)
@for_each(("roughness", "cosine"), [(0.05, 0.1), (0.3, 0.5), (0.7, 1.0), (1.0, 0.1)])
def test_the_albedo_is_what_brute_force_gives(
    smith: Smith, roughness: float, cosine: float
) -> None:
    alpha = np.array(roughness**2)
    fast = directional_albedo(stretched(np.array(cosine), alpha), alpha, smith)
    # Where facets stop to reflect upwards, the grid of a million is good to some 1e-4.
    assert abs(fast - slow_albedo(cosine, float(alpha), smith)) < 5e-4


def test_at_normal_incidence_the_albedo_has_its_closed_form_and_falls_with_roughness() -> None:
    """On alpha = 1, where D = 1 / pi: the integral of c / (1 + c), 1 - ln 2."""
    for smith in SMITHS:
        assert abs(directional_albedo(1.0, 1.0, smith) - (1 - np.log(2))) < 1e-9
        assert (np.diff(albedo_table(smith)[:, -1]) < 1e-6).all()
        assert ((albedo_table(smith) > 0.3) & (albedo_table(smith) < 1.0005)).all()


@for_each("smith", SMITHS)
def test_the_table_is_exact_between_its_entries(
    smith: Smith, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From roughness 0.01 to 1, from the normal to a cosine of 1e-4: also at the dip of smooth
    surfaces, where the cosine is alpha."""
    rng = np.random.default_rng(0)
    roughness = np.exp(rng.uniform(np.log(0.01), 0, 800))
    cosine = np.concatenate([np.exp(rng.uniform(np.log(1e-4), 0, 400)), rng.uniform(0, 1, 400)])
    dip = np.linspace(0.3, 3, 800) * roughness**2
    places = np.linspace(0, 1, ROUGHNESS_STEPS), np.linspace(0, 1, X_STEPS)
    table = RegularGridInterpolator(places, albedo_table(smith))
    read = []  # what both tracers read from the table
    for c in (cosine, np.minimum(dip, 1)):
        x = stretched(c, roughness**2)
        read.append((x, table(np.stack([roughness, np.sqrt(x)], axis=-1))))
    monkeypatch.setattr(optics, "_INNER", 32)
    monkeypatch.setattr(optics, "_OUTER", 32)
    for x, values in read:
        exact = directional_albedo(x, roughness**2, smith)
        # A furnace is off by as much as E is: a fifth of the 1 % that is allowed.
        assert abs(values / exact - 1).max() < 2.5e-3
    assert exact.min() < 0.9 * exact.max()


@for_each(("smith", "expected"), [("correlated", 0.409), ("separable", 0.377)])
def test_the_mean_is_that_of_the_albedo(smith: Smith, expected: float) -> None:
    node, weight = np.polynomial.legendre.leggauss(64)
    cosine = (node + 1) / 2
    for roughness in (0.02, 0.3, 0.62, 1.0):
        alpha = np.array(roughness**2)
        exact = (directional_albedo(stretched(cosine, alpha), alpha, smith) * cosine * weight).sum()
        # linear between 32 roughnesses
        assert abs(mean_albedo(alpha[None], smith)[0] - exact) < 1e-3
    # As measured elsewhere, to three digits.
    assert abs(mean_albedo(np.ones(1), smith)[0] - expected) < 6e-4


def test_a_colour_returns_its_own_series_of_reflections_and_single_precision_stays() -> None:
    """Fms = F Eavg (1 + F (1 - Eavg) + ...): each further reflection absorbs again."""
    specular, alpha = np.array([[1.0, 0.5, 0.0]]), np.array([0.49])
    mean = mean_albedo(alpha, "correlated")[0]
    series = sum(specular * mean * (specular * (1 - mean)) ** k for k in range(200))
    np.testing.assert_allclose(scattered_again(specular, alpha, "correlated"), series, rtol=1e-12)
    assert scattered_again(specular, alpha, "correlated")[0, 0] == pytest.approx(1)
    base, metal = np.full((2, 3), 0.5, np.float32), np.zeros((2, 1), np.float32)
    assert {each.dtype for each in constant_albedos(base, metal)} == {np.dtype(np.float32)}


@for_each(("f0", "f90"), [(0.04, 1.0), (0.0, 0.0), (0.02, 0.5), (1.0, 1.0)])
@for_each("metal", [0.0, 0.3, 1.0])
def test_the_lobe_has_the_cosine_weighted_mean_of_schlick(
    f0: float, f90: float, metal: float
) -> None:
    base = np.array([0.9, 0.5, 0.0])
    count = 20_000
    cosine = np.sqrt((np.arange(count) + 0.5) / count)[:, None]  # drawn by the cosine
    low, high = (1 - metal) * f0 + metal * base, (1 - metal) * f90 + metal
    curve = low + (high - low) * (1 - cosine) ** 5
    diffuse, specular = constant_albedos(base, np.array([metal]), f0, f90)
    # the mean of 20,000 strips
    assert specular + 0 * base == pytest.approx(curve.mean(axis=0), abs=1e-6)
    assert diffuse == pytest.approx(base * (1 - metal) * (1 - specular))
    assert (diffuse + specular <= 1 + 1e-12).all()
