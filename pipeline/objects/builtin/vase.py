"""Lathed vases: a wall of even thickness around a smooth profile, plain, fluted or swirled.

Unlike closed bodies, open vessels let light in, and their inside shades itself.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.objects.builtin.solids import Mesh, sphere_faces


def sample_vase(rng: np.random.Generator) -> Mesh:
    """Return a random vase: a closed surface (outside, lip, inside)."""
    # Outer radii at equal heights from foot to lip, joined by a smooth curve.
    radii = rng.uniform(0.16, 0.55, int(rng.integers(4, 7)))
    flutes = int(rng.choice([0, 0, 5, 6, 8, 10]))  # folds around the vase; 0 is plain
    columns = int(rng.integers(28, 45))
    columns -= columns % max(flutes, 1)  # so that all flutes are alike
    height = rng.uniform(0.7, 1.6)
    wall = rng.uniform(0.025, 0.06)  # thickness of wall and bottom
    flute_depth = rng.uniform(0.1, 0.35)  # as a share of the radius
    swirl_rad = rng.uniform(-0.8, 0.8)  # turn of the folds from foot to lip
    rings = int(rng.integers(14, 21))  # from foot to lip
    level = np.linspace(0, 1, rings)
    inner_height = wall + (height - wall) * level
    inner = _smooth(radii, inner_height / height) - wall
    radius = np.concatenate([_smooth(radii, level), inner[::-1]])
    heights = np.concatenate([height * level, inner_height[::-1]])
    azimuth = 2 * np.pi * np.arange(columns) / columns
    phase = flutes * (azimuth[None] + swirl_rad * heights[:, None] / height)
    fold = 1 - flute_depth * (0.5 - 0.5 * np.cos(phase)) * bool(flutes)
    folded = radius[:, None] * fold
    upright = np.broadcast_to(heights[:, None], folded.shape)
    grid = np.stack([folded * np.cos(azimuth), folded * np.sin(azimuth), upright], axis=-1)
    poles = [[0.0, 0.0, 0.0], [0.0, 0.0, wall]]
    return np.concatenate([grid.reshape(-1, 3), poles]), sphere_faces(2 * rings, columns)


def _smooth(values: NDArray[np.float64], where: NDArray[np.float64]) -> NDArray[np.float64]:
    """Evaluate a Catmull-Rom curve through equally spaced `values` at positions in [0, 1].

    The curve may overshoot the values by an eighth of their differences; callers leave a margin.
    """
    padded = np.concatenate([[2 * values[0] - values[1]], values, [2 * values[-1] - values[-2]]])
    position = np.clip(where, 0, 1) * (len(values) - 1)
    segment = np.minimum(position.astype(np.int64), len(values) - 2)
    step = (position - segment)[:, None] ** np.arange(4)
    basis = 0.5 * np.array([[0, 2, 0, 0], [-1, 0, 1, 0], [2, -5, 4, -1], [-1, 3, -3, 1]])
    return np.einsum("nk,kj,nj->n", step, basis, padded[segment[:, None] + np.arange(4)])
