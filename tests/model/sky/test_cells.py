"""Cells of a sky: equal parts of the sphere, means of the map, exact under symmetries."""

import numpy as np
from numpy.typing import NDArray

from model.sky.cells import cell_of, sky_cells
from model.sky.symmetries import behind_mirror, scaled, turned, with_channels
from scene_templates.rotations import uniform_rotation
from storage.records.environment import Environment
from storage.records.lookup import environment_values
from storage.records.sky_texels import row_solid_angles
from tests.for_each import for_each
from tests.sky_maps import as_sky, centres, constant, night, one_sun, smooth

COUNTS = [48, 192]


def _on_sphere(count: int, seed: int = 0) -> NDArray[np.float64]:
    found = np.random.default_rng(seed).normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


@for_each("count", COUNTS)
def test_cells_are_equal_parts_of_the_sphere_and_hang_together(count: int) -> None:
    places = _on_sphere(200_000)
    cells = cell_of(places, count)
    found = np.bincount(cells, minlength=count)
    # 200,000 / 192 places, of which random numbers miss 3 %: five times that.
    assert len(found) == count
    assert np.abs(found / found.mean() - 1).max() < 5 * np.sqrt(count / 200_000)
    middle = np.stack([np.bincount(cells, places[:, c]) for c in range(3)], axis=-1)
    middle = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    farthest = np.degrees(np.arccos((places * middle[cells]).sum(axis=1).clip(-1, 1))).max()
    assert farthest < {48: 32, 192: 16.5}[count]  # a disc of that area has a radius of 16.6 or 8.3


@for_each("count", COUNTS)
def test_quarter_turns_and_mirrors_of_the_map_permute_the_cells(count: int) -> None:
    places = _on_sphere(5_000, seed=1)
    before = cell_of(places, count)
    for turn in (
        np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
        np.diag([-1, 1, 1]),
        np.diag([1, 1, -1]),
    ):
        after = cell_of(places @ turn.T, count)
        pairs = np.unique(np.stack([before, after], axis=-1), axis=0)
        assert len(pairs) == len(np.unique(before))


@for_each("count", COUNTS)
@for_each("height", [1, 3, 64, 300])
def test_a_constant_sky_is_constant(count: int, height: int) -> None:
    cells = sky_cells(constant((0.5, 2.0, 1e5), height), count)
    assert cells.radiance_S3.shape == (count, 3)
    # Sums in float64 of equal numbers, rounded once.
    assert np.abs(cells.radiance_S3 / np.array([0.5, 2.0, 1e5]) - 1).max() < 1e-6
    assert np.abs(np.linalg.norm(cells.direction_S3, axis=1) - 1).max() < 0.06


def test_cells_are_means_of_the_map() -> None:
    """Beside a slow twin that asks the map's own definition at random places."""
    rotation = uniform_rotation(np.random.default_rng(5)).astype(np.float32)
    sky = smooth(rotation=rotation)
    cells, places = sky_cells(sky, 48), _on_sphere(60_000, seed=2)
    owner, radiance = cell_of(sky.to_map(places), 48), environment_values(sky, places)
    for cell in range(48):
        there = owner == cell
        # 1,250 places a cell, in which this sky spreads by 0.1 at most; texels are not interpolated
        # here, which moves a mean by less.
        assert np.abs(cells.radiance_S3[cell] - radiance[there].mean(axis=0)).max() < 0.01
        weight = radiance[there].sum(axis=1, keepdims=True)
        along = (places[there] * weight).sum(axis=0) / weight.sum()
        assert np.abs(cells.direction_S3[cell] - along).max() < 0.02


def _light(sky: Environment) -> NDArray[np.float64]:
    """Return the light of all texels together."""
    angles = row_solid_angles(len(sky.radiance_rgb))[:, None, None]
    total: NDArray[np.float64] = (sky.radiance_rgb.astype(np.float64) * angles).sum(axis=(0, 1))
    return total


@for_each("count", COUNTS)
def test_a_sun_keeps_its_light_and_its_place(count: int) -> None:
    sky = one_sun(1e6)
    cells = sky_cells(sky, count)
    brightest = cells.radiance_S3[:, 0].argmax()
    sun = centres(64)[16, 67]
    assert np.abs(cells.direction_S3[brightest] - sun).max() < 0.01  # not the middle of its cell
    total = cells.radiance_S3.sum(axis=0) * (4 * np.pi / count)
    assert np.abs(total / _light(sky) - 1).max() < 0.01  # cells of these places are equal to 1 %


@for_each("count", COUNTS)
def test_scene_and_sky_turned_together_have_the_same_cells_elsewhere(count: int) -> None:
    sky, rotation = night(), uniform_rotation(np.random.default_rng(3))
    before, after = sky_cells(sky, count), sky_cells(turned(sky, rotation), count)
    assert np.array_equal(before.radiance_S3, after.radiance_S3)
    # The rotation is kept in float32.
    assert np.abs(after.direction_S3 - before.direction_S3 @ rotation.T).max() < 1e-6


def test_mirrors_colours_and_scale_are_exact() -> None:
    sky = smooth(rotation=uniform_rotation(np.random.default_rng(4)).astype(np.float32))
    before, order = sky_cells(sky, 48), np.array([2, 0, 1])
    coloured = sky_cells(with_channels(sky, order), 48)
    assert np.array_equal(coloured.radiance_S3, before.radiance_S3[:, order])
    assert np.array_equal(coloured.direction_S3, before.direction_S3)
    brighter = sky_cells(scaled(sky, 4.0), 48)
    assert np.array_equal(brighter.radiance_S3, 4 * before.radiance_S3)
    assert np.abs(brighter.direction_S3 - before.direction_S3).max() < 1e-6
    sides = np.array([-1, 1, 1], np.float32)
    mirrored = sky_cells(behind_mirror(sky, sides), 48)

    def rows(radiance: NDArray, direction: NDArray) -> NDArray:
        both = np.concatenate([direction, radiance], axis=-1).round(4)
        return np.array(sorted(map(tuple, both + 0.0)))

    # The same cells in another order: mirrored lines are lines. Sums in another order round alike.
    expected = rows(before.radiance_S3, before.direction_S3 * sides)
    found = rows(mirrored.radiance_S3, mirrored.direction_S3)
    assert np.abs(found - expected).max() < 3e-4


def test_a_sky_that_is_black_in_most_directions_has_finite_cells() -> None:
    texels = np.zeros((8, 16, 3), np.float32)
    texels[2, 3] = 1e6
    cells = sky_cells(as_sky(texels), 192)
    assert np.isfinite(cells.direction_S3).all()
    assert (cells.radiance_S3 == 0).all(axis=1).sum() > 150
