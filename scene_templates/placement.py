"""Places objects in the room: resting or floating, with a collision test.

Sizes and rotations are drawn first, then places, the largest object first and each several times
over, before sizes are given up and drawn again. Drawing whole arrangements until one fits would be
exactly uniform, but takes ten times as long and prefers small objects; here sizes stay near their
stated range. What an object looks like is asked of its `PlaceableShape`; a template knows no
meshes.
"""

from collections.abc import Sequence
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from scene_templates.checks import Range
from scene_templates.layout import Pose
from scene_templates.rooms import Room
from scene_templates.rotations import Orientation, rotate_points, sample_rotation
from storage.errors import Rejected
from storage.settings.described import checked
from storage.settings.ranges import Share

ARRANGEMENT_TRIES = 100
"""Draws of all sizes before the scene is given up."""

PLACE_TRIES = 16
"""Draws of one place before the sizes are drawn again."""


@checked("scene settings")
class PlacementSettings:
    """How objects are placed in the room."""

    orientation: Orientation = "uniform"
    """Distribution of the objects' rotations: `uniform` on SO(3), `euler` as published, which
    favors the poles, or `kept` as in their files."""
    resting_share: Share = 0.5
    """Share of objects that rest on the floor; the others float. The published ones all float."""
    overlap_share: Share = 0.1
    """Share of scenes whose objects may intersect, so that a network sees contact and penetration
    too. In the others no two meshes meet; in the published ones all may."""
    inside: bool = True
    """Keep objects on the room's side of the floor and walls. Otherwise, as published, their
    centres are uniform in the cube [-0.5, 0.5]^3 and they may stick through."""


class PlaceableShape(Protocol):
    """An object's mesh, scaled into the unit sphere around the origin."""

    @property
    def points(self) -> NDArray[np.float64]:
        """Vertices [V, 3] whose hull holds the mesh."""
        ...

    def overlaps(self, pose: Pose, other: Self, its_pose: Pose) -> bool:
        """Return whether two meshes in their places share a point, or one holds the other."""
        ...


def place_objects(
    rng: np.random.Generator,
    settings: PlacementSettings,
    room: Room,
    shapes: Sequence[PlaceableShape],
    *,
    object_scale: Range,
    overlaps: bool,
) -> tuple[Pose, ...]:
    """Draw a pose for each shape.

    Args:
        rng: where the numbers come from.
        settings: how objects are placed.
        room: where; without shell parts, in the middle of the world.
        shapes: what they look like.
        object_scale: range of the bounding spheres' diameters, before halving.
        overlaps: whether objects may meet.

    Raises:
        Rejected: "no_room" if no arrangement was found.
    """
    for _ in range(ARRANGEMENT_TRIES):
        # A recipe's size is a diameter in a room of side 2: half of it here, and half again.
        radii = rng.uniform(*object_scale, size=len(shapes)) / 4
        poses: dict[int, Pose] = {}
        for row in np.argsort(-radii, kind="stable").tolist():
            obstacles = [] if overlaps else [(shapes[other], at) for other, at in poses.items()]
            pose = _sample_pose(rng, settings, room, shapes[row], float(radii[row]), obstacles)
            if pose is None:
                break
            poses[row] = pose
        if len(poses) == len(shapes):
            return tuple(poses[row] for row in range(len(shapes)))
    raise Rejected("no_room", f"{len(shapes)} objects met in {ARRANGEMENT_TRIES} arrangements")


def _sample_pose(
    rng: np.random.Generator,
    settings: PlacementSettings,
    room: Room,
    shape: PlaceableShape,
    radius: float,
    obstacles: Sequence[tuple[PlaceableShape, Pose]],
) -> Pose | None:
    """Draw a place for an object clear of others, or None where none was found."""
    rotation = sample_rotation(rng, settings.orientation)
    rests = bool(rng.random() < settings.resting_share)
    if not room.patches:
        pose = Pose(centre=np.zeros(3), radius=radius, rotation=rotation)
        return None if any(shape.overlaps(pose, other, at) for other, at in obstacles) else pose
    points = radius * rotate_points(shape.points, rotation)
    low = np.full(3, -0.5)
    high = np.full(3, 0.5)
    if settings.inside:
        low, high = room.centre_range(points, radius)
        if rests:
            # it is set down below
            low[2] = 0.0
            high[2] = 0.0
    if (low > high).any():
        return None
    for _ in range(PLACE_TRIES):
        centre = rng.uniform(low, high)
        if rests:
            # until the lowest point touches; it need not be in balance
            floor = room.planes[0]
            height = floor.height(points + centre).min()
            centre = centre - height / floor.normal[2] * np.array([0, 0, 1.0])
        if settings.inside and not room.holds(points + centre):
            continue
        pose = Pose(centre=centre, radius=radius, rotation=rotation)
        if not any(shape.overlaps(pose, other, at) for other, at in obstacles):
            return pose
    return None
