"""A sky under symmetries: the light that comes from where they put it."""

import numpy as np

from model.sky.symmetries import behind_mirror, scaled, turned, with_channels
from scene_templates.rotations import uniform_rotation
from storage.records.lookup import environment_values
from tests.sky_maps import smooth

SKY = smooth(rotation=uniform_rotation(np.random.default_rng(8)).astype(np.float32))
DIRECTIONS = np.random.default_rng(0).normal(size=(500, 3))
HERE = environment_values(SKY, DIRECTIONS)


def test_light_comes_from_where_a_symmetry_puts_it() -> None:
    """Rotations are kept in float32, by which this sky changes by less than 1e-6."""
    rotation, sides = uniform_rotation(np.random.default_rng(9)), np.array([-1, 1, 1], np.float32)
    there = environment_values(turned(SKY, rotation), DIRECTIONS @ rotation.T)
    assert np.abs(there - HERE).max() < 3e-6
    mirrored = behind_mirror(SKY, sides)
    mirrored.check()
    assert np.abs(environment_values(mirrored, DIRECTIONS * sides) - HERE).max() < 3e-6
    order = np.array([1, 2, 0])
    assert np.array_equal(environment_values(with_channels(SKY, order), DIRECTIONS), HERE[:, order])
    assert np.abs(environment_values(scaled(SKY, 3.0), DIRECTIONS) - 3 * HERE).max() < 1e-6


def test_two_mirrors_are_none() -> None:
    sides = np.array([-1, 1, 1], np.float32)
    twice = behind_mirror(behind_mirror(SKY, sides), sides)
    assert np.array_equal(twice.radiance_rgb, SKY.radiance_rgb)
    assert np.array_equal(twice.rotation, SKY.rotation)
