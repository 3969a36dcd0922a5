"""Lathed vases: a wall of even thickness around a smooth profile, plain, fluted or swirled.

Unlike closed bodies, open vessels let light in, and their inside shades itself.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.objects.builtin.grids import Mesh, sphere_faces


@dataclass(frozen=True, kw_only=True)
class VaseParams:
    """Shape of one vase."""

    height: float  # from foot to lip
    radii: tuple[float, ...]
    """Outer radii at equal heights from foot to lip, joined by a smooth curve; all positive."""
    wall: float  # thickness of wall and bottom; smaller than every radius
    flutes: int  # folds around the vase; 0 is plain
    flute_depth: float  # depth of the folds as a share of the radius, in [0, 1)
    swirl_rad: float  # turn of the folds from foot to lip
    rings: int  # rings from foot to lip
    columns: int  # vertices of a ring; a multiple of the flutes makes them all alike


def vase(params: VaseParams) -> Mesh:
    """Return the closed surface (outside, lip, inside) of 4 rings columns triangles."""
    level = np.linspace(0, 1, params.rings)
    outer = _smooth(np.array(params.radii), level)
    inner_height = params.wall + (params.height - params.wall) * level
    inner = _smooth(np.array(params.radii), inner_height / params.height) - params.wall
    radius = np.concatenate([outer, inner[::-1]])
    height = np.concatenate([params.height * level, inner_height[::-1]])
    azimuth = 2 * np.pi * np.arange(params.columns) / params.columns
    phase = params.flutes * (azimuth[None] + params.swirl_rad * height[:, None] / params.height)
    fold = 1 - params.flute_depth * (0.5 - 0.5 * np.cos(phase)) * bool(params.flutes)
    rings = radius[:, None] * fold
    upright = np.broadcast_to(height[:, None], rings.shape)
    grid = np.stack([rings * np.cos(azimuth), rings * np.sin(azimuth), upright], axis=-1)
    poles = [[0.0, 0.0, 0.0], [0.0, 0.0, params.wall]]
    positions = np.concatenate([grid.reshape(-1, 3), poles])
    return positions, sphere_faces(2 * params.rings, params.columns)


def sample_vase(rng: np.random.Generator) -> Mesh:
    """Return a random vase."""
    radii = rng.uniform(0.16, 0.55, int(rng.integers(4, 7)))
    flutes = int(rng.choice([0, 0, 5, 6, 8, 10]))
    columns = int(rng.integers(28, 45))
    return vase(
        VaseParams(
            height=float(rng.uniform(0.7, 1.6)),
            radii=tuple(radii.tolist()),
            wall=float(rng.uniform(0.025, 0.06)),
            flutes=flutes,
            flute_depth=float(rng.uniform(0.1, 0.35)),
            swirl_rad=float(rng.uniform(-0.8, 0.8)),
            rings=int(rng.integers(14, 21)),
            columns=columns - columns % max(flutes, 1),
        )
    )


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
