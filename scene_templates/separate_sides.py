"""Shells as published: floor and walls are drawn each by itself, in two background policies.

`original` keeps the spin of a square about its own axis within a few degrees, so that the diagonals
of its triangulation always run one way, and keeps floors at one height. The public recipes repair
that (they call it a de-bias): squares spin freely, and floors move. The numbers of both are in
`renderformer_v1`; here is how they are drawn from. Parts may leave gaps or cut through each other.
"""

from collections.abc import Sequence
from typing import Annotated

import numpy as np

from scene_templates.checks import SHIFT, SIZE, Range
from scene_templates.rooms import SIDES, PatchPlacement, Room
from storage.settings.described import checked
from storage.settings.ranges import Within


@checked("scene settings")
class SideRanges:
    """Ranges from which the placement of one floor or wall is drawn."""

    spin_deg: Annotated[float, Within(0, 180, unit="degrees")] = 0.0
    """Maximum rotation about its own normal, in either direction."""
    tilt_deg: Annotated[float, Within(0, 90, unit="degrees")] = 0.0
    """Maximum rotation about each of the other two axes."""
    scale: Annotated[Range, SIZE] = (1.0, 1.0)
    """Scale per axis; 1 fills the side of the nominal room."""
    shift_x: Annotated[Range, SHIFT] = (0.0, 0.0)
    """Shift along X, for a room of side 2."""
    shift_y: Annotated[Range, SHIFT] = (0.0, 0.0)
    """Shift along Y, for a room of side 2."""
    shift_z: Annotated[Range, SHIFT] = (0.0, 0.0)
    """Shift along Z, for a room of side 2."""

    def sample_placement(self, rng: np.random.Generator, axis: int) -> PatchPlacement:
        """Draw the place of a side that is perpendicular to `axis` before it is turned."""
        angles_deg = rng.uniform(-self.tilt_deg, self.tilt_deg, size=3)
        angles_deg[axis] = rng.uniform(-self.spin_deg, self.spin_deg)
        x, y, z = (rng.uniform(*range_) for range_ in (self.shift_x, self.shift_y, self.shift_z))
        return PatchPlacement(
            rotation_deg=tuple(angles_deg),
            reach=1.0,
            scale=tuple(rng.uniform(*self.scale, size=3)),
            translation=(x, y, z),
        )


@checked("scene settings")
class SeparateSides:
    """Ranges of floor and walls that are drawn independently of each other, as published."""

    floor: SideRanges
    """Ranges of the floor."""
    wall0: SideRanges = SideRanges()
    """Ranges of the wall at +Y, if the template has one."""
    wall1: SideRanges = SideRanges()
    """Ranges of the wall at +X."""
    wall2: SideRanges = SideRanges()
    """Ranges of the wall at -X."""
    wall2_faces_out: bool = False
    """Turn the front of the wall at -X away from the room, as in the original policy."""

    def sample_room(self, rng: np.random.Generator, names: Sequence[str]) -> Room:
        """Draw the sides `names`; the space between them is the nominal room."""
        patches = [getattr(self, name).sample_placement(rng, SIDES[name].axis) for name in names]
        return Room(patches=tuple(patches), low=np.full(3, -0.5), high=np.full(3, 0.5), lean=0.0)
