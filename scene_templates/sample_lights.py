"""Samples emitters (lights): a few small bright triangles outside the room, on its open side."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from scene_templates.checks import OFFSET, SIZE, Counts, Range
from scene_templates.layout import Emitter
from scene_templates.rotations import Orientation, rotate_points, sample_rotation
from scene_templates.sample_camera import Sector
from storage.settings.described import checked
from storage.settings.ranges import Share, Within

TRIANGLE = 0.025 * np.array([[-1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, -1.0]])
"""The published emitter before scaling: equilateral, edge 0.0707."""

SPACING_RADIUS = 0.75**0.5
"""Radius of the sphere on which the spacing of emitters is measured."""

SPACING_TRIES = 256
"""Eight emitters 0.3 apart claim four tenths of the narrowest sector, so that this is hardly ever
used up; the candidate farthest from the others is taken if it is."""

MOST_LIGHTS = 64
"""Maximum number whose pictures can be kept apart (storage.records.lights); published: 8."""

PALEST = 0.2
"""Least channel of a coloured light before its mean is made 1: no light is quite monochrome."""


@checked("scene settings")
class LightSettings:
    """Ranges and shares from which emitters are drawn."""

    count: Annotated[Counts, Within(0, MOST_LIGHTS, unit="emitters")] = (1, 8)
    """Minimum and maximum number of emitters; each count is equally likely. 0 is for
    scenes that all have a sky."""
    total_emission: Annotated[Range, Within(1e-3, 1e9)] = (2500.0, 5000.0)
    """Range of the total radiance: each of n emitters gets a number from this range, divided by n.
    """
    scale: Annotated[Range, SIZE] = (2.0, 2.5)
    """Scale per axis of the emitter triangle, whose edge is 0.0707 world units at scale 1."""
    distance: Annotated[Range, SIZE] = (2.1, 2.7)
    """Distance of an emitter from its target near the origin (see `target_jitter`), in world units.
    """
    target_jitter: Annotated[float, OFFSET] = 0.2
    """Maximum offset per axis of an emitter's target from the origin."""
    spacing: Annotated[float, Within(0, 2 * SPACING_RADIUS)] = 0.3
    """Minimum distance between two emitters after projection from the origin onto a sphere of
    radius 0.866."""
    orientation: Orientation = "uniform"
    """Distribution of the emitters' rotations; see `PlacementSettings.orientation`."""
    coloured_share: Share = 0.0
    """Share of emitters that are colored instead of white, with the same mean radiance. An option:
    published lights are white, and a network trained on white ones alone has never seen another."""
    reflectance: Share = 0.0
    """Diffuse albedo of an emitter. What shines at 300 need not reflect; the published ones do,
    with an albedo of 1."""
    num_inside: Annotated[int, Within(0, MOST_LIGHTS, unit="emitters")] = 0
    """Number of emitters that are placed in the middle of objects instead, for tests out of
    distribution."""


def sample_lights(
    rng: np.random.Generator,
    settings: LightSettings,
    sector: Sector,
    count: int,
    object_centres: Sequence[NDArray[np.float64]],
) -> tuple[Emitter, ...]:
    """Draw `count` emitters of a scene; the first `num_inside` go into objects, as far as any."""
    directions: list[NDArray[np.float64]] = []
    for _ in range(count):
        directions.append(_spaced_direction(rng, sector, directions, settings.spacing))
    inside = list(object_centres)[: settings.num_inside]
    jitter = settings.target_jitter
    outside = [
        rng.uniform(-jitter, jitter, size=3) + rng.uniform(*settings.distance) * towards
        for towards in directions[len(inside) :]
    ]
    return tuple(_sample_emitter(rng, settings, centre, count) for centre in [*inside, *outside])


def _spaced_direction(
    rng: np.random.Generator,
    sector: Sector,
    placed_directions: list[NDArray[np.float64]],
    spacing: float,
) -> NDArray[np.float64]:
    best = sector.sample_direction(rng)
    best_gap = -1.0
    for _ in range(SPACING_TRIES):
        candidate = sector.sample_direction(rng)
        distances = [
            float(np.sqrt(np.sum(np.square(candidate - other)))) for other in placed_directions
        ]
        gap = SPACING_RADIUS * min(distances, default=np.inf)
        if gap > best_gap:
            best = candidate
            best_gap = gap
        if gap > spacing:
            break
    return best


def _sample_emitter(
    rng: np.random.Generator, settings: LightSettings, centre: NDArray[np.float64], count: int
) -> Emitter:
    """Draw orientation, size, emission and tint at random."""
    # About its own middle, so that its distance is the one drawn.
    turned = rotate_points(
        TRIANGLE - TRIANGLE.mean(axis=0), sample_rotation(rng, settings.orientation)
    )
    triangle = turned * rng.uniform(*settings.scale, size=3) + centre
    radiance = rng.uniform(*settings.total_emission) / count
    red, green, blue = radiance * _sample_tint(rng, settings.coloured_share)
    return Emitter(
        triangle=triangle, radiance_rgb=(red, green, blue), reflectance=settings.reflectance
    )


def _sample_tint(rng: np.random.Generator, coloured_share: float) -> NDArray[np.float64]:
    if rng.random() >= coloured_share:
        return np.ones(3)
    channels = rng.uniform(PALEST, 1, size=3)
    return channels / channels.mean()
