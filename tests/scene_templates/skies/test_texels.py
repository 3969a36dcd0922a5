"""Texels of the sphere: orientation, solid angles, shapes with exact flux, noise without a seam."""

import math

import numpy as np
import pytest

from scene_templates.skies.texels import SkyTexels
from storage.seeds import rng_for
from tests.for_each import for_each


def uv_of(direction: np.ndarray) -> tuple[float, float]:
    """Return where a map shows a direction: the convention, in other words than the product's."""
    x, y, z = direction
    return 0.5 - math.atan2(y, x) / (2 * math.pi), 0.5 + math.asin(z) / math.pi


def _unit(seed: int) -> np.ndarray:
    vector = rng_for(seed, "direction").standard_normal(3)
    return vector / np.sqrt(np.square(vector).sum())


@for_each(
    ("u", "v", "axis"),
    [
        (0.5, 0.5, (1, 0, 0)),
        (0.25, 0.5, (0, 1, 0)),
        (0.75, 0.5, (0, -1, 0)),
        (0.0, 0.5, (-1, 0, 0)),
        (0.5, 1.0, (0, 0, 1)),
        (0.5, 0.0, (0, 0, -1)),
    ],
)
def test_orientation_is_blenders(u: float, v: float, axis: tuple[int, int, int]) -> None:
    height = 64
    row, column = min(int((1 - v) * height), height - 1), int(u * 2 * height)
    found = SkyTexels(height).directions[row, column]
    # half a texel, in both directions, from the place that is meant
    assert math.acos(np.clip(found @ axis, -1, 1)) < math.sqrt(0.5) * math.pi / height * 1.01


def test_texel_centres_are_where_the_convention_shows_them() -> None:
    height = 16
    directions = SkyTexels(height).directions
    np.testing.assert_allclose(np.square(directions).sum(axis=-1), 1, atol=1e-14)
    for row in range(height):
        for column in range(2 * height):
            u, v = uv_of(directions[row, column])
            assert u * 2 * height == pytest.approx(column + 0.5, abs=1e-9)
            assert (1 - v) * height == pytest.approx(row + 0.5, abs=1e-9)


@for_each("height", [1, 2, 7, 64])
def test_solid_angles_sum_to_the_sphere(height: int) -> None:
    texels = SkyTexels(height)
    ones = np.ones((height, 2 * height))
    assert float(texels.flux(ones)) == pytest.approx(4 * math.pi, rel=1e-13)
    assert texels.solid_angle.shape == (height, 1) and (texels.solid_angle > 0).all()


def test_a_white_sky_sends_pi_onto_the_ground() -> None:
    found = SkyTexels(64).irradiance(np.ones((64, 128, 3)))
    # the midpoint rule on 64 rows errs by (pi / 64)^2 / 6
    np.testing.assert_allclose(found, math.pi, rtol=5e-4)


@for_each("height", [1, 2, 8, 33, 64, 256])
def test_a_spot_has_unit_flux_and_is_where_it_should_be(height: int) -> None:
    texels = SkyTexels(height)
    for seed in range(12):
        towards = _unit(seed) if seed else np.array([0.0, 0.0, 1.0])
        spot = texels.spot(towards)
        assert (spot >= 0).all()
        assert float(texels.flux(spot)) == pytest.approx(1, rel=1e-13)
        brightest = np.unravel_index(np.argmax(spot), spot.shape)
        angle = math.acos(np.clip(texels.directions[brightest] @ towards, -1, 1))
        # the nearest centre: half a diagonal of a texel away at most
        assert angle <= math.sqrt(0.5) * math.pi / height + 1e-9
        if height >= 8:
            lit = (spot > 0) * texels.solid_angle
            # a cap of 1.5 rows, and texels whose centres are in it: a few
            assert lit.sum() < 2 * math.pi * (1.5 * math.pi / height) ** 2


def test_a_spot_shines_from_its_direction() -> None:
    """Its mean direction, which decides where shadows fall, is that of the sun to a tenth of it."""
    texels = SkyTexels(64)
    for seed in range(20):
        towards = _unit(seed)
        mean = texels.flux(texels.spot(towards)[..., None] * texels.directions)
        off = math.acos(min(1.0, float(mean @ towards) / float(np.sqrt(mean @ mean))))
        assert off < 0.25 * math.pi / 64


@pytest.mark.parametrize("sharpness", [0.5, 4.0, 60.0])
def test_a_lobe_has_its_closed_form(sharpness: float) -> None:
    """The integral of (1 + k (1 - c))^-2 over the sphere is 4 pi / (1 + 2 k)."""
    texels, towards = SkyTexels(128), _unit(1)
    found = texels.lobe(towards, sharpness)
    below = 1 + sharpness * (1 - texels.directions @ towards)
    expected = (1 + 2 * sharpness) / (4 * math.pi) / np.square(below)
    # 128 rows integrate a lobe of 10 degrees to a thousandth
    np.testing.assert_allclose(found, expected, rtol=2e-3)


def test_a_pane_has_the_solid_angle_of_a_rectangle() -> None:
    """4 asin(a b / sqrt((1 + a^2)(1 + b^2))), half of it below a bar of half its width."""
    texels = SkyTexels(256)
    for seed in range(3):
        towards, half = _unit(seed), (0.4, 0.25)
        expected = 4 * math.asin(
            half[0] * half[1] / math.sqrt((1 + half[0] ** 2) * (1 + half[1] ** 2))
        )
        found = float(texels.flux(texels.pane(towards, half, roll_rad=seed / 2)))
        # edges are ramps of about a texel whose width grows off the middle
        assert found == pytest.approx(expected, rel=0.03)
        barred = texels.pane(towards, half, panes=(2, 2), bars=0.5)
        # of each pane, a quarter is clear
        assert float(texels.flux(barred)) == pytest.approx(expected / 4, rel=0.08)
        assert (texels.pane(towards, half)[(texels.directions @ towards) < 0] == 0).all()


def test_panes_without_a_roll_stand_upright() -> None:
    pane = SkyTexels(64).pane(np.array([1.0, 0.0, 0.0]), (0.8, 0.2))
    rows, columns = np.nonzero(pane > 0.5)
    assert np.ptp(columns) > 2 * np.ptp(rows)


def test_a_shape_between_all_texels_becomes_a_spot() -> None:
    texels, towards = SkyTexels(4), _unit(3)
    nothing = np.zeros((4, 8))
    np.testing.assert_array_equal(texels.of_unit_flux(nothing, towards), texels.spot(towards))


def test_noise_is_the_same_all_over_the_sphere() -> None:
    """Neither the seam at u = 0 nor the poles show: steps in space decide steps of the noise."""
    texels = SkyTexels(128)
    fields = np.stack([texels.noise(rng_for(seed, "noise"), 4.0) for seed in range(12)])
    seam = fields[:, :, 0] - fields[:, :, -1]
    inside = fields[:, :, 64] - fields[:, :, 63]
    # 12 x 25 independent cells along each line: a deviation to 1 / sqrt(600), and five times that
    assert seam.std() == pytest.approx(inside.std(), rel=0.25)
    # around a pole, texels lie closer and closer: so do their values
    around_pole = np.abs(np.diff(fields[:, 0], axis=1)).max()
    assert around_pole < 0.1 * np.abs(np.diff(fields[:, 64], axis=1)).max()
    assert 0.3 < fields.std() < 0.5
    weight = np.broadcast_to(texels.solid_angle, (128, 256))
    rows = [np.sqrt(np.average(np.square(fields[:, part]), weights=np.stack([weight[part]] * 12)))
            for part in (slice(0, 32), slice(48, 80), slice(96, 128))]  # fmt: skip
    assert max(rows) < 1.4 * min(rows), "poles and equator have one deviation"


def test_octaves_that_texels_cannot_show_are_left_out() -> None:
    texels = SkyTexels(64)  # cells of up to 64 / 4 pi = 5.1 a radius
    few = texels.noise(rng_for(0, "noise"), 2.0, octaves=2)
    np.testing.assert_array_equal(few, texels.noise(rng_for(0, "noise"), 2.0, octaves=9))
    assert np.abs(few - texels.noise(rng_for(0, "noise"), 2.0)).max() > 0.01
