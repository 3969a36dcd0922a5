"""Where objects go: spheres in the room that do not meet, some of them on the floor.

Sizes are drawn first, then places, the largest first and each several times over, before sizes
are given up and drawn anew. Drawing whole arrangements until one fits would be exactly uniform,
but takes ten times as long and prefers small objects; here sizes stay near their stated range. A
resting object will be lowered until its mesh touches the floor, so it claims the way down as well.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene_templates.layout import Floor, ObjectPlacement
from scene_templates.materials import surface_rand
from scene_templates.patches import SIDES
from scene_templates.rooms import Room
from scene_templates.rotations import uniform_rotation
from scene_templates.settings import SceneSettings
from storage.errors import Rejected

ARRANGEMENT_TRIES = 100
"""Draws of all sizes before the scene is given up."""

PLACE_TRIES = 16
"""Draws of one place before the sizes are drawn anew."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectSpace:
    """Where the centres of objects may be."""

    room: Room
    """The space between the shell parts."""
    parts: tuple[str, ...]
    """The shell parts that exist."""
    floor: Floor
    """Where objects rest."""

    def centre_range(self, radius: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the least and greatest centre [3] of a sphere.

        A sphere keeps clear of walls; through an open side it may stick out by half its radius.
        """
        low = np.clip(self.room.low, -0.5, 0.5) + radius / 2
        high = np.clip(self.room.high, -0.5, 0.5) - radius / 2
        for name in self.parts:
            axis, clear = SIDES[name].axis, radius + self.room.lean
            if SIDES[name].sign > 0:
                high[axis] = self.room.high[axis] - clear
            else:
                low[axis] = self.room.low[axis] + clear
        return low, high


@dataclass(frozen=True, kw_only=True, eq=False)
class _Sphere:
    centre: NDArray[np.float64]
    radius: float
    rests: bool


def objects_rand(
    rng: np.random.Generator, settings: SceneSettings, space: ObjectSpace, count: int
) -> tuple[ObjectPlacement, ...]:
    """Draw `count` placements; raises Rejected("no_room") if none was found without overlap."""
    for _ in range(ARRANGEMENT_TRIES):
        spheres = _spheres_rand(rng, settings, space, count)
        if spheres is not None:
            break
    else:
        raise Rejected("no_room", f"{count} objects met in {ARRANGEMENT_TRIES} arrangements")
    return tuple(
        ObjectPlacement(
            centre=sphere.centre,
            radius=sphere.radius,
            rotation=uniform_rotation(rng),
            rests=sphere.rests,
            surface=surface_rand(rng, settings),
        )
        for sphere in spheres
    )


def _spheres_rand(
    rng: np.random.Generator, settings: SceneSettings, space: ObjectSpace, count: int
) -> list[_Sphere] | None:
    """Draw one arrangement, or None where no place was found for one of the objects."""
    scale = settings.single_object_scale if count == 1 else settings.object_scale
    # A recipe's size is a diameter in a room of side 2: half of it here, and half again.
    radii = np.sort(rng.uniform(*scale, size=count) / 4)[::-1]
    spheres: list[_Sphere] = []
    for radius in radii.tolist():
        rests = bool(rng.random() < settings.resting_share)
        sphere = _placed_rand(rng, space, spheres, radius, rests)
        if sphere is None:
            return None
        spheres.append(sphere)
    return spheres


def _placed_rand(
    rng: np.random.Generator,
    space: ObjectSpace,
    others: Sequence[_Sphere],
    radius: float,
    rests: bool,
) -> _Sphere | None:
    low, high = space.centre_range(radius)
    if (low > high).any():
        return None
    for _ in range(PLACE_TRIES):
        centre = rng.uniform(low, high)
        height = float(space.floor.height(centre))
        if rests:
            centre[2] += (radius - height) / space.floor.normal[2]
        elif height < radius:
            continue
        sphere = _Sphere(centre=centre, radius=radius, rests=rests)
        if not any(_gap(space.floor, sphere, other) < 0 for other in others):
            return sphere
    return None


def _gap(floor: Floor, a: _Sphere, b: _Sphere) -> float:
    """Return the distance between two spheres, counting the way down of those that rest."""
    top_a, top_b = float(floor.height(a.centre)), float(floor.height(b.centre))
    # The centre of a resting mesh comes to lie between 0 and its radius above the floor.
    bottom_a, bottom_b = (0.0 if a.rests else top_a), (0.0 if b.rests else top_b)
    above = max(0.0, bottom_a - top_b, bottom_b - top_a)
    apart = a.centre - b.centre
    aside_squared = float(np.sum(np.square(apart))) - (top_a - top_b) ** 2
    return float(np.sqrt(max(0.0, aside_squared) + above**2)) - a.radius - b.radius
