"""Pictures today against stored ones, as a statistical test, corrected for its many pixels.

Both are means of independent passes, so that their difference over its standard deviation is a
standard normal variable where nothing has changed. The variance is the stored one of 512 passes:
that of the few passes at hand would itself be random.
"""

from pathlib import Path

import matplotlib
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from pipeline.renders.load_tracer import load_tracer
from tests.pipeline.renders import stored_pictures
from tests.pipeline.renders.stored_pictures import StoredPicture

matplotlib.use("Agg")
import matplotlib.pyplot as plt

SIGNIFICANCE = 0.001
"""Chance of a false alarm of one test, over all pixels and channels together."""

NUM_PASSES = 10

BLOCK = {"diffuse": 2, "glossy": 4, "two-lamps": 4}
"""Pixels each way that one test takes together. The mean of 10 passes of a pixel is not normal yet:
4.8 deviations seen with diffuse paths, and 9 with glossy ones, which have few bright ones among
them. That of a block is: in six seeds none was off by more than 4."""


def z_values(
    mean_rgb: NDArray[np.float64], stored: StoredPicture, block: int
) -> NDArray[np.float64]:
    """Return the difference of blocks in standard deviations, [R/block, R/block, 3].

    It is 0 where both are without noise.
    """
    variance = stored.pass_variance * (1 / NUM_PASSES + 1 / stored.num_passes)
    # A picture stored in float32 is off by 6e-8 of its value: no noise, no difference beyond that.
    noise = np.sqrt(_blocks(variance, block)) / block + 1e-6 * _blocks(stored.mean_rgb, block)
    difference = _blocks(mean_rgb - stored.mean_rgb, block)
    return np.divide(difference, noise, out=np.zeros_like(difference), where=noise > 0)


def _blocks(values: NDArray[np.float64], block: int) -> NDArray[np.float64]:
    size = len(values) // block
    return values.reshape(size, block, size, block, 3).mean(axis=(1, 3))


def smallest_p(z: NDArray[np.float64]) -> float:
    """Return the smallest two-sided p, corrected for the number of tests (Bonferroni)."""
    return float(2 * stats.norm.sf(np.abs(z).max()) * z.size)


def mean_p(z: NDArray[np.float64]) -> float:
    """Return the p of the mean: small shifts of many pixels, which no single one shows.

    The channels of a pixel share their paths, so that only pixels count as independent.
    """
    total = z.mean(axis=-1).sum() / np.sqrt(z.shape[0] * z.shape[1])
    return float(2 * stats.norm.sf(abs(total)))


@pytest.mark.parametrize("name", sorted(stored_pictures.scenes()))
def test_the_picture_is_the_stored_one_within_noise(name: str, tmp_path: Path) -> None:
    scene, stored = stored_pictures.scenes()[name], stored_pictures.load(name)
    tracer = load_tracer(scene, max_depth=10, rr_depth=2)
    mean = stored_pictures.passes(tracer, scene, NUM_PASSES, seed=7).mean(axis=0)
    z = z_values(mean, stored, BLOCK[name])
    if min(smallest_p(z), mean_p(z)) < SIGNIFICANCE:
        path = _drawn(mean, stored, z, tmp_path / f"{name}.png")
        pytest.fail(f"largest |z| {np.abs(z).max():.1f}, mean {z.mean():.3f}; look at {path}")


def test_a_picture_one_percent_brighter_is_found() -> None:
    """Against the stored picture itself, so that only the change can be seen."""
    for name in stored_pictures.scenes():
        stored = stored_pictures.load(name)
        brighter = z_values(1.01 * stored.mean_rgb, stored, BLOCK[name])
        assert mean_p(brighter) < SIGNIFICANCE, name


def test_one_wrong_pixel_is_found() -> None:
    stored = stored_pictures.load("diffuse")
    wrong = stored.mean_rgb.copy()
    wrong[30, 20] *= 1.5
    assert smallest_p(z_values(wrong, stored, BLOCK["diffuse"])) < SIGNIFICANCE


def _drawn(
    mean: NDArray[np.float64], stored: StoredPicture, z: NDArray[np.float64], path: Path
) -> Path:
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(10, 3.5), layout="constrained")
    for axes, picture, title in (
        (left, mean, "today"),
        (middle, stored.mean_rgb, "stored"),
    ):
        axes.imshow(np.clip(picture, 0, 1) ** (1 / 2.2))
        axes.set_title(title)
    shown = right.imshow(z.mean(axis=-1), cmap="coolwarm", vmin=-5, vmax=5)
    right.set_title("difference in standard deviations")
    figure.colorbar(shown, ax=right)
    figure.savefig(path)
    plt.close(figure)
    return path
