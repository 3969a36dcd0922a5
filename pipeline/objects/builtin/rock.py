"""Rocks: balls cut by planes, softly or sharply, with bumps and with layers.

Large flat facets that meet at any angle, unlike on a grid of rings.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.objects.builtin.grids import Mesh
from pipeline.objects.builtin.solids import icosphere


@dataclass(frozen=True, kw_only=True)
class RockParams:
    """Shape of one rock; it starts as a ball of radius 1."""

    cuts: tuple[tuple[float, float, float, float], ...]
    """Planes that cut the ball: a unit direction and the distance from the center."""
    sharpness: float  # of the edges between cuts: 6 is a pebble, 30 a broken stone
    bumps: tuple[tuple[float, float, float, float], ...]
    """Waves over the surface: waves per radius along x, y and z, and a phase."""
    bump_height: float  # of all bumps together, in radii; below 0.5
    layers: float  # layers per radius of height; 0 is none
    layer_depth: float  # how far the joints between layers are cut back, in radii; below 0.3
    half_sizes: tuple[float, float, float]  # stretch along x, y and z
    frequency: int  # divisions of the icosahedron's edges


def rock(params: RockParams) -> Mesh:
    """Return the closed surface of 20 frequency^2 triangles, star-shaped about the origin."""
    direction, faces = icosphere(params.frequency)
    radius = _cut_ball(direction, params)
    if params.bumps:
        waves = np.array(params.bumps)
        swing = np.sin(2 * np.pi * direction @ waves[:, :3].T + waves[:, 3]).mean(axis=1)
        radius = radius * (1 + params.bump_height * swing)
    if params.layers:
        height = params.layers * (radius * direction[:, 2] + 0.1 * direction[:, 0])
        # A narrow joint per layer: the fourth power of a wave is flat but near its crest.
        joint = np.cos(np.pi * height) ** 4
        radius = radius - params.layer_depth * joint * radius * (1 - direction[:, 2] ** 2)
    return direction * radius[:, None] * np.array(params.half_sizes), faces


def sample_rock(rng: np.random.Generator) -> Mesh:
    """Return a random rock."""
    kind = rng.choice(["pebble", "broken", "layered"])
    cuts = _rand_cuts(rng, int(rng.integers(9, 22)))
    sizes = rng.uniform(0.55, 1.0, 3)
    waves = rng.normal(size=(12, 4)) * [0.5, 0.5, 0.5, 3.0]
    return rock(
        RockParams(
            cuts=_rows(cuts),
            sharpness=float(rng.uniform(5, 12) if kind == "pebble" else rng.uniform(16, 36)),
            bumps=_rows(waves),
            bump_height=float(
                rng.uniform(0.1, 0.4) if kind == "pebble" else rng.uniform(0.02, 0.1)
            ),
            layers=float(rng.uniform(1.6, 3.2)) if kind == "layered" else 0.0,
            layer_depth=float(rng.uniform(0.06, 0.16)),
            half_sizes=(float(sizes[0]), float(sizes[1]), float(sizes[2])),
            frequency=int(
                rng.integers(*{"pebble": (5, 10), "broken": (9, 16)}.get(kind, (14, 18)))
            ),
        )
    )


def _cut_ball(direction: NDArray[np.float64], params: RockParams) -> NDArray[np.float64]:
    """Return the distance [N] of the cut ball's surface in each direction [N, 3].

    The hard surface is the nearest plane; the norm of the inverse distances rounds its edges.
    """
    planes = np.array(params.cuts)
    inverse = np.maximum(direction @ planes[:, :3].T, 0) / planes[:, 3]
    ball = np.ones((len(direction), 1))
    every = np.concatenate([inverse, ball], axis=1)
    return (every**params.sharpness).sum(axis=1) ** (-1 / params.sharpness)


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


def _rows(values: NDArray[np.float64]) -> tuple[tuple[float, float, float, float], ...]:
    return tuple((float(a), float(b), float(c), float(d)) for a, b, c, d in values)
