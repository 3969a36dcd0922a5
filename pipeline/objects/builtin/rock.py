"""Rocks: balls cut by planes, softly or sharply, with bumps and with layers.

Large flat facets that meet at any angle, unlike on a grid of rings.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.objects.builtin.solids import Mesh, icosphere


def sample_rock(rng: np.random.Generator) -> Mesh:
    """Return a random rock: a closed surface, star-shaped about the origin, from a unit ball."""
    kind = rng.choice(["pebble", "broken", "layered"])
    cuts = _rand_cuts(rng, int(rng.integers(9, 22)))
    sizes = rng.uniform(0.55, 1.0, 3)  # stretch along x, y and z
    # Bumps over the surface: waves per radius along x, y and z, and a phase.
    waves = rng.normal(size=(12, 4)) * [0.5, 0.5, 0.5, 3.0]
    sharpness = rng.uniform(5, 12) if kind == "pebble" else rng.uniform(16, 36)
    bump_height = rng.uniform(0.1, 0.4) if kind == "pebble" else rng.uniform(0.02, 0.1)
    layers = rng.uniform(1.6, 3.2) if kind == "layered" else 0.0  # per radius of height
    layer_depth = rng.uniform(0.06, 0.16)  # how far joints between layers are cut back
    frequency = rng.integers(*{"pebble": (5, 10), "broken": (9, 16)}.get(kind, (14, 18)))
    direction, faces = icosphere(int(frequency))
    radius = _cut_ball(direction, cuts, sharpness)
    swing = np.sin(2 * np.pi * direction @ waves[:, :3].T + waves[:, 3]).mean(axis=1)
    radius = radius * (1 + bump_height * swing)
    if layers:
        height = layers * (radius * direction[:, 2] + 0.1 * direction[:, 0])
        # A narrow joint per layer: the fourth power of a wave is flat but near its crest.
        joint = np.cos(np.pi * height) ** 4
        radius = radius - layer_depth * joint * radius * (1 - direction[:, 2] ** 2)
    return direction * radius[:, None] * sizes, faces


def _cut_ball(
    direction: NDArray[np.float64], planes: NDArray[np.float64], sharpness: float
) -> NDArray[np.float64]:
    """Return the distance [N] of the cut ball's surface in each direction [N, 3].

    The hard surface is the nearest plane [K, 4]: a unit direction and the distance from the center.
    The norm of the inverse distances rounds its edges: 6 is a pebble, 30 a broken stone.
    """
    inverse = np.maximum(direction @ planes[:, :3].T, 0) / planes[:, 3]
    every = np.concatenate([inverse, np.ones((len(direction), 1))], axis=1)
    return (every**sharpness).sum(axis=1) ** (-1 / sharpness)


def _rand_cuts(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Return planes [count, 4] in even directions with a random rotation and noise."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    azimuth = np.pi * (1 + np.sqrt(5)) * index + rng.uniform(0, 6)
    ring = np.sqrt(1 - z * z)
    spread = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)
    spread += rng.normal(size=spread.shape) * 0.35
    spread /= np.linalg.norm(spread, axis=1, keepdims=True)
    return np.column_stack([spread, rng.uniform(0.55, 0.9, count)])
