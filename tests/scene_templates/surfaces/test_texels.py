"""Texels: orientation; noise on a torus; the nearest of many points, against a slow twin."""

import numpy as np
import pytest

from scene_templates.surfaces.texels import Texels, stones
from storage.seeds import rng_for


def test_the_first_row_is_the_top_and_the_first_column_the_left() -> None:
    texels = Texels(4)
    assert texels.u.tolist() == [[0.125, 0.375, 0.625, 0.875]]
    assert texels.v.ravel().tolist() == [0.875, 0.625, 0.375, 0.125]


def test_noise_has_mean_0_and_the_stated_deviation() -> None:
    found = np.stack([Texels(64).noise(rng_for(seed, "noise"), (8, 8)) for seed in range(200)])
    # 64 cells in each of 200 fields: the mean of 12,800 numbers of deviation 0.4, five times over
    assert abs(found.mean()) < 5 * 0.4 / np.sqrt(12800)
    assert 0.35 < found.std() < 0.45
    assert np.abs(found).max() < 2


def test_noise_prefers_no_direction() -> None:
    """Slopes along u, v and both diagonals have the same mean square, by the same covariance."""
    found = np.stack([Texels(64).noise(rng_for(seed, "noise"), (8, 8)) for seed in range(200)])
    along = [np.square(found - np.roll(found, 1, axis)).mean() for axis in (1, 2)]
    # 12,800 independent cells: a mean square is known to about 1 %
    assert along[0] == pytest.approx(along[1], rel=0.05)
    diagonals = [np.square(found - np.roll(found, (1, step), (1, 2))).mean() for step in (1, -1)]
    assert diagonals[0] == pytest.approx(diagonals[1], rel=0.05)
    assert sum(diagonals) / 2 == pytest.approx(sum(along), rel=0.1)


def test_noise_is_smooth_across_the_edge_of_the_map() -> None:
    found = Texels(256).noise(rng_for(0, "noise"), (4, 4))
    for axis in (0, 1):
        steps = np.abs(found - np.roll(found, 1, axis))
        across = np.take(steps, 0, axis)
        assert across.max() <= steps.max()
        # a cell is 64 texels: the steepest slope, of about 2 a cell, is 0.06 a texel
        assert steps.max() < 0.1


def test_octaves_that_texels_cannot_show_are_left_out() -> None:
    def noise(size: int, octaves: int) -> np.ndarray:
        return Texels(size).noise(rng_for(0, "noise"), (4, 8), octaves=octaves)

    np.testing.assert_array_equal(noise(64, 2), noise(64, 9))  # 8 and 16 cells of 4 texels
    assert np.abs(noise(64, 1) - noise(64, 2)).max() > 0.01
    assert (noise(16, 9) == 0).all()


@pytest.mark.parametrize("jitter", [0.5, 1.0])
def test_the_nearest_stone_is_the_nearest(jitter: float) -> None:
    """Against all points and their copies on the eight maps around."""
    cells, texels = 5, Texels(32)
    found = stones(texels, rng_for(1, "stones"), cells, jitter=jitter)
    offsets = 0.5 + jitter * (rng_for(1, "stones").random((cells, cells, 2)) - 0.5)
    row, column = np.mgrid[:cells, :cells]
    points = np.stack([column + offsets[..., 0], row + offsets[..., 1]], axis=-1).reshape(-1, 2)
    steps = np.array([(x, y) for x in (-cells, 0, cells) for y in (-cells, 0, cells)])
    copies = (points[:, None] + steps).reshape(-1, 2)
    places = np.stack(np.broadcast_arrays(texels.u, texels.v), axis=-1) * cells
    away = np.sqrt(np.square(places[:, :, None] - copies).sum(axis=-1))
    order = np.argsort(away, axis=-1)
    np.testing.assert_array_equal(found.index, order[..., 0] // len(steps))
    nearest = np.take_along_axis(away, order[..., :2], axis=-1)
    np.testing.assert_allclose(found.nearest, nearest[..., 0], atol=1e-12)
    # the second nearest may be two squares away, where 3 x 3 squares do not look; it is then
    # farther than any of their points, in few texels and by little
    off = np.abs(found.gap - (nearest[..., 1] - nearest[..., 0]))
    assert (off > 1e-12).mean() < 0.02 and off.max() < 0.3
