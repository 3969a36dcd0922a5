"""Emitters: a few small bright triangles outside the room, on its open side."""

import numpy as np
from numpy.typing import NDArray

from scene_templates.layout import Emitter
from scene_templates.rotations import rotated, uniform_rotation
from scene_templates.sectors import Sector
from scene_templates.settings import SceneSettings

TRIANGLE = 0.025 * np.array([[-1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, -1.0]])
"""The published emitter before scaling: equilateral, edge 0.0707."""

SPACING_RADIUS = 0.75**0.5
"""Radius of the sphere on which the spacing of emitters is measured."""

SPACING_TRIES = 256
"""Eight emitters 0.3 apart claim four tenths of the narrowest sector, so that this is hardly ever
used up; the candidate farthest from the others is taken if it is."""


def emitters_rand(
    rng: np.random.Generator, settings: SceneSettings, sector: Sector
) -> tuple[Emitter, ...]:
    """Draw the emitters of a scene."""
    low, high = settings.num_lights
    count = int(rng.integers(low, high + 1))
    directions: list[NDArray[np.float64]] = []
    for _ in range(count):
        directions.append(_spaced_direction(rng, sector, directions, settings.light_spacing))
    return tuple(_emitter_rand(rng, settings, towards, count) for towards in directions)


def _spaced_direction(
    rng: np.random.Generator,
    sector: Sector,
    others: list[NDArray[np.float64]],
    spacing: float,
) -> NDArray[np.float64]:
    best, best_gap = sector.direction_rand(rng), -1.0
    for _ in range(SPACING_TRIES):
        candidate = sector.direction_rand(rng)
        away = [float(np.sqrt(np.sum(np.square(candidate - other)))) for other in others]
        gap = SPACING_RADIUS * min(away, default=np.inf)
        if gap > best_gap:
            best, best_gap = candidate, gap
        if gap > spacing:
            break
    return best


def _emitter_rand(
    rng: np.random.Generator, settings: SceneSettings, towards: NDArray[np.float64], count: int
) -> Emitter:
    target = rng.uniform(-settings.target_jitter, settings.target_jitter, size=3)
    centre = target + rng.uniform(*settings.light_distance) * towards
    # About its own middle, so that its distance is the one drawn.
    turned = rotated(TRIANGLE - TRIANGLE.mean(axis=0), uniform_rotation(rng))
    triangle = turned * rng.uniform(*settings.light_scale, size=3) + centre
    return Emitter(triangle=triangle, radiance=rng.uniform(*settings.total_emission) / count)
