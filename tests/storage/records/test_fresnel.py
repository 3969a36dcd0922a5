"""Albedos without a Fresnel term: the mean of Schlick's curve, never more than all light."""

import numpy as np
import pytest

from storage.records.fresnel import constant_albedos
from tests.for_each import for_each


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


def test_single_precision_stays() -> None:
    base, metal = np.full((2, 3), 0.5, np.float32), np.zeros((2, 1), np.float32)
    assert {each.dtype for each in constant_albedos(base, metal)} == {np.dtype(np.float32)}
