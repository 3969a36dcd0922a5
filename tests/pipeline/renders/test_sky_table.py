"""The map inside the kernel against the definition of what a map says, and its own densities."""

import mitsuba as mi
import numpy as np
import pytest

from pipeline.renders.sky_share import peaked_radiance, sky_share
from pipeline.renders.sky_table import SkyTable, alias_rows
from scene_templates.rotations import uniform_rotation
from storage.records.lookup import environment_values
from storage.records.sky_texels import row_solid_angles, texel_means
from tests.pipeline.renders.scene_kit import join, light, material, quad
from tests.sky_maps import as_sky, constant, night, one_sun, six_poles, smooth

pytestmark = pytest.mark.usefixtures("llvm")


def _turned(seed: int) -> np.ndarray:
    return uniform_rotation(np.random.default_rng(seed)).astype(np.float32)


MAPS = [
    smooth(rotation=_turned(1)),
    one_sun(rotation=_turned(2)),
    six_poles(rotation=_turned(3)),
    as_sky(np.random.default_rng(0).random((1, 2, 3))),
    as_sky(np.random.default_rng(1).random((3, 6, 3)) ** 8, rotation=_turned(4)),
]


@pytest.mark.parametrize("number", range(len(MAPS)))
def test_radiance_is_that_of_the_definition(number: int) -> None:
    sky, rng = MAPS[number], np.random.default_rng(number)
    directions = rng.normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    level = sky.rotation.T[:2]  # the seam is among them; at the poles u is what rounding makes it
    directions = np.concatenate([directions, level, -level])
    found, _ = SkyTable(sky, 1.0).radiance_and_density(mi.Vector3f(directions.T), mi.Bool(True))
    expected = environment_values(sky, directions)
    # float32 angles are off by 3e-7 radians, which is 6e-6 texels of 128 across, of the greatest
    # difference between texels.
    error = np.abs(np.array(found).T - expected).max()
    assert error < 2e-5 * sky.radiance_rgb.max() + 1e-6


@pytest.mark.parametrize("number", range(len(MAPS)))
def test_directions_come_with_the_density_that_is_stated(number: int) -> None:
    """The mean of L / density over drawn directions is the flux of the map, and so by octants."""
    sky, count = MAPS[number], 1 << 15
    table, rng = SkyTable(sky, 0.7), np.random.default_rng(5)
    drawn = table.sample(mi.Point2f(rng.random((2, count)).astype(np.float32)), mi.Bool(True))
    directions = np.array(drawn.direction).T
    assert np.abs(np.linalg.norm(directions, axis=1) - 1).max() < 1e-6
    again = table.radiance_and_density(drawn.direction, mi.Bool(True))[1]
    np.testing.assert_array_equal(np.array(again), np.array(drawn.density))
    weighed = np.array(drawn.radiance).T / (np.array(drawn.density)[:, None] / np.float32(0.7))
    octant = (directions > 0) @ np.array([1, 2, 4])
    uniform = rng.normal(size=(1 << 16, 3))
    uniform /= np.linalg.norm(uniform, axis=1, keepdims=True)
    flux = environment_values(sky, uniform) * 4 * np.pi
    place = (uniform > 0) @ np.array([1, 2, 4])
    for part in range(8):
        ours, theirs = weighed * (octant == part)[:, None], flux * (place == part)[:, None]
        error = np.hypot(*(v.std(axis=0) / np.sqrt(len(v)) for v in (ours, theirs)))
        # Five standard errors of both; octants without light agree exactly but for roundings.
        assert (np.abs(ours.mean(axis=0) - theirs.mean(axis=0)) < 5 * error + 1e-6).all(), part


def test_a_sun_of_one_texel_is_drawn_by_what_its_neighbours_have_of_it() -> None:
    """Estimates of its flux by one draw differ by the slope within texels, not by 10,000 times."""
    sky = one_sun()
    table, rng = SkyTable(sky, 1.0), np.random.default_rng(6)
    drawn = table.sample(mi.Point2f(rng.random((2, 1 << 16)).astype(np.float32)), mi.Bool(True))
    weighed = np.array(drawn.radiance)[0] / np.array(drawn.density)
    # A tent that is drawn by its means over texels: measured 1.05.
    assert weighed.std() < 1.2 * weighed.mean()


def test_alias_tables_have_the_shares_of_their_weights() -> None:
    rng = np.random.default_rng(7)
    weights = np.concatenate([rng.random((5, 37)) ** 6, np.ones((1, 37)), np.zeros((1, 37))])
    weights[0, 3:] = 0
    weights[1, 5] = 1e6
    keep, alias = alias_rows(weights)
    share = keep.copy()
    for row in range(len(weights)):
        np.add.at(share[row], alias[row], 1 - keep[row])
    expected = np.ones_like(weights)
    expected[:-1] = 37 * weights[:-1] / weights[:-1].sum(axis=1, keepdims=True)
    # Sums of 37 numbers in double precision.
    np.testing.assert_allclose(share, expected, atol=1e-12)
    assert ((keep >= 0) & (keep <= 1)).all()


def test_texel_means_are_means_over_texels() -> None:
    values = np.random.default_rng(8).random((4, 8))
    sky = as_sky(np.repeat(values[..., None], 3, axis=-1))
    table, fine = texel_means(sky.radiance_rgb[..., 0].astype(np.float64)), 50
    v = (np.arange(4 * fine) + 0.5) / (4 * fine)
    u = (np.arange(8 * fine) + 0.5) / (8 * fine)
    theta, azimuth = np.pi * v[:, None], (0.5 - u[None]) * 2 * np.pi
    flat = np.sin(theta)
    where = np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), np.cos(theta) + 0 * azimuth], axis=-1
    )
    found = environment_values(sky, where)[..., 0].reshape(4, fine, 8, fine).mean(axis=(1, 3))
    np.testing.assert_allclose(table, found, rtol=1e-3)  # midpoints of 50 steps at the knots


def test_the_share_goes_by_peaks_and_is_a_lamps_at_least() -> None:
    floor = quad([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], material(diffuse=0.5))
    lamps = [
        light([[0.0, 0.0, 2.0], [0.1, 0.0, 2.0], [0.0, 0.1, 2.0]], 20.0),
        light([[0.0, 1.0, 2.0], [1.0, 1.0, 2.0], [0.0, 2.0, 2.0]], 1.0),
    ]
    scene = join([floor, *lamps])
    power = 0.005 * 20 + 0.5 * 1.0
    for flat in (constant(0.05), constant(30.0)):
        assert sky_share(scene, flat) == pytest.approx(1 / 3)  # one of three
    sun = one_sun()
    assert row_solid_angles(64).sum() * 128 == pytest.approx(4 * np.pi)
    excess = row_solid_angles(64)[16] / (4 * np.pi) * (1e5 * (1 + 0.9 + 0.7) / 3 - 0.2)
    assert peaked_radiance(sun) == pytest.approx(excess, rel=1e-6)
    weight = 2 * np.pi * 2.0 * excess  # half of the floor's diagonal is the root of 2
    assert sky_share(scene, sun) == pytest.approx(weight / (weight + power), rel=1e-6)
    assert sky_share(join([floor], sky=sun), sun) == 1
    assert peaked_radiance(night()) > 0
