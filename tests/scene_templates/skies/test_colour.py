"""Colours of black bodies, against Planck's law and the observer of 1931."""

import numpy as np

from scene_templates.skies.colour import COOLEST_MIRED, WARMEST_MIRED, planckian_rgb
from tests.for_each import for_each

WAVELENGTHS_NM = np.arange(380.0, 781.0)
_XYZ_TO_REC709 = np.linalg.inv(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750],
     [0.0193339, 0.1191920, 0.9503041]]
)  # fmt: skip


def _lobes(*rows: tuple[float, float, float, float]) -> np.ndarray:
    total = np.zeros_like(WAVELENGTHS_NM)
    for height, middle, below, above in rows:
        width = np.where(WAVELENGTHS_NM < middle, below, above)
        total += height * np.exp(-0.5 * np.square((WAVELENGTHS_NM - middle) / width))
    return total


OBSERVER = np.stack(
    [
        _lobes((1.056, 599.8, 37.9, 31.0), (0.362, 442.0, 16.0, 26.7), (-0.065, 501.1, 20.4, 26.2)),
        _lobes((0.821, 568.8, 46.9, 40.5), (0.286, 530.9, 16.3, 31.1)),
        _lobes((1.217, 437.0, 11.8, 36.0), (0.681, 459.0, 26.0, 13.8)),
    ]
)
"""The fit of Wyman et al. (2013), table 1."""


@for_each("mired", [COOLEST_MIRED, 80, 153.8, 249, 251, 300, 400, 449, 451, 499])
def test_a_black_body_has_the_colour_of_plancks_law(mired: float) -> None:
    metres = WAVELENGTHS_NM * 1e-9
    spectrum = metres**-5 / np.expm1(0.014387769 / metres / (1e6 / mired))
    rgb = _XYZ_TO_REC709 @ (OBSERVER @ spectrum)
    # both fits are good to about 0.003 of a chromaticity, up to 2 % of a channel's mean of 1
    np.testing.assert_allclose(planckian_rgb(mired), rgb / rgb.mean(), atol=0.04)


def test_colours_are_positive_with_a_mean_of_1_and_no_jump() -> None:
    found = np.array([planckian_rgb(m) for m in np.linspace(COOLEST_MIRED, WARMEST_MIRED, 2000)])
    assert (found >= 0).all()
    np.testing.assert_allclose(found.mean(axis=1), 1, rtol=1e-14)
    # 0.23 mired a step, where the steepest channel changes by 0.006 a mired; the pieces of the
    # fit meet within a thousandth
    assert np.abs(np.diff(found, axis=0)).max() < 0.01
    assert (np.diff(found[:, 0]) > -0.003).all(), "warmer is redder"
