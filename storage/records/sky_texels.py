"""Light through each texel of an environment map."""

import numpy as np
from numpy.typing import NDArray


def row_solid_angles(height: int) -> NDArray[np.float64]:
    """Return the steradians [H] of a texel in each row of a map with 2 H columns."""
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    angles: NDArray[np.float64] = (edges[:-1] - edges[1:]) * np.pi / height
    return angles


def texel_means(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean over each texel [H, W] of what interpolation between their centres gives."""
    wide = np.pad(values, ((1, 1), (0, 0)), mode="edge")
    tall = (wide[:-2] + 6 * wide[1:-1] + wide[2:]) / 8
    round_about = np.pad(tall, ((0, 0), (1, 1)), mode="wrap")
    means: NDArray[np.float64] = (
        round_about[:, :-2] + 6 * round_about[:, 1:-1] + round_about[:, 2:]
    ) / 8
    return means
