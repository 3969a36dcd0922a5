"""Shells whose seams are always closed: the floor and walls of one room.

The published shells place each square by itself (`SeparateSides`): walls then hang over gaps. Here
the parts share one room. In square rooms a spin is a multiple of 90 degrees, which still swaps the
diagonals, and edges meet exactly. In the others the spin is free, parts tilt a little, and every
square is made just large enough to cover its side of the room: parts cross instead of gaping, at
the price of some hidden triangles.

A patch is a square of 128 triangles. The order of its transforms is the published one: turn about
X, Y, Z, scale per axis, move, halve.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scene_templates.checks import OFFSET, SHIFT, SIZE, Range
from scene_templates.rotations import rotate_points, rotation_xyz
from storage.settings.described import checked
from storage.settings.ranges import Share, Within

QUADS = 8
"""Quads per side of a patch: 8 x 8 x 2 = 128 triangles."""

TOUCHING = 1e-9
"""World units below which a resting object still counts as inside: rounding of float64 sums."""


class Side(NamedTuple):
    """One side of the nominal room, the cube [-1, 1]^3 before halving."""

    axis: int
    """The axis that the side is perpendicular to."""
    sign: int
    """The end of that axis at which it stands."""


SIDES = MappingProxyType(
    {
        "floor": Side(axis=2, sign=-1),
        "wall0": Side(axis=1, sign=1),
        "wall1": Side(axis=0, sign=1),
        "wall2": Side(axis=0, sign=-1),
    }
)
"""The parts that a shell may have. -Y and +Z are open in every template."""


@dataclass(frozen=True, kw_only=True)
class PatchPlacement:
    """Transform of a patch from its side of the nominal room."""

    rotation_deg: tuple[float, float, float]
    """About X, then Y, then Z, through the middle of the room; the angle about the side's own
    axis spins the patch in its plane."""
    reach: float
    """Half the side of the square; 1 fills the side of the nominal room exactly."""
    scale: tuple[float, float, float]
    """Factor for each axis, applied first."""
    translation: tuple[float, float, float]
    """Translation after scaling, world units."""


def patch(side: Side, placement: PatchPlacement) -> NDArray[np.float64]:
    """Return the vertices [81, 3] of a patch in world units; `PATCH_FACES` joins them."""
    line = np.linspace(-placement.reach, placement.reach, QUADS + 1)
    u, v = (grid.ravel() for grid in np.meshgrid(line, line, indexing="ij"))
    local = np.zeros((len(u), 3))
    # The two axes in the plane, in the order that makes u x v point into the room.
    first = (side.axis + 1) % 3
    second = (side.axis + 2) % 3
    local[:, first], local[:, second] = (v, u) if side.sign > 0 else (u, v)
    local[:, side.axis] = side.sign
    turned = rotate_points(local, rotation_xyz(placement.rotation_deg))
    return (turned * placement.scale + placement.translation) / 2


_GRID = np.arange((QUADS + 1) ** 2, dtype=np.uint32).reshape(QUADS + 1, QUADS + 1)
_CORNERS = np.stack([_GRID[:-1, :-1], _GRID[1:, :-1], _GRID[1:, 1:], _GRID[:-1, 1:]], axis=-1)

PATCH_FACES: NDArray[np.uint32] = _CORNERS[..., [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
"""[128, 3], counter-clockwise seen from the room."""
PATCH_FACES.setflags(write=False)


class Plane:
    """The infinite plane of a floor or wall."""

    def __init__(self, positions: NDArray[np.float64]) -> None:
        """Take the plane of a patch, vertices [81, 3]."""
        self._point = positions.mean(axis=0)
        normal = np.cross(positions[-9] - positions[0], positions[8] - positions[0])
        self.normal = normal / np.sqrt(np.sum(np.square(normal)))
        """[3] unit, into the room."""

    def height(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the signed distance of `points` [..., 3] on the side of the room."""
        return np.einsum("...i,i->...", points - self._point, self.normal)


@dataclass(frozen=True, kw_only=True, eq=False)
class Room:
    """The shell parts in their places, and the space between them for objects."""

    patches: Mapping[str, PatchPlacement]
    """Placements of the shell parts that exist, by name, the floor first."""
    low: NDArray[np.float64]
    """[3] the lower corner of the upright room, world units."""
    high: NDArray[np.float64]
    """Upper corner [3] in world units."""
    lean: float
    """How far a tilted wall may stand inside of these bounds at most."""

    @cached_property
    def positions(self) -> list[NDArray[np.float64]]:
        """Vertices [81, 3] of each part."""
        return [patch(SIDES[name], placement) for name, placement in self.patches.items()]

    @cached_property
    def planes(self) -> list[Plane]:
        """The plane of each part; objects rest on the first."""
        return [Plane(positions) for positions in self.positions]

    def centre_range(
        self, points: NDArray[np.float64], radius: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the least and greatest centre [3] of an object with `points` [V, 3] around it.

        It keeps clear of walls; through an open side it may stick out by half its radius.
        """
        low = np.clip(self.low, -0.5, 0.5) + radius / 2
        high = np.clip(self.high, -0.5, 0.5) - radius / 2
        for name in self.patches:
            axis = SIDES[name].axis
            if SIDES[name].sign > 0:
                high[axis] = self.high[axis] - self.lean - points[:, axis].max()
            else:
                low[axis] = self.low[axis] + self.lean - points[:, axis].min()
        return low, high

    def holds(self, points: NDArray[np.float64]) -> bool:
        """Return whether all points [V, 3] are on the room's side of every part."""
        return all(bool((plane.height(points) >= -TOUCHING).all()) for plane in self.planes)


@checked("scene settings")
class SharedRoom:
    """Ranges of rooms whose floor and walls meet at their edges."""

    square_share: Share = 0.5
    """Share of scenes whose floor and walls are exact rectangles of one room, edge to edge."""
    scale: Annotated[Range, SIZE] = (1.0, 1.35)
    """Scale of the room per axis (1 is the nominal room); floor and walls share it, so that they
    meet."""
    shift: Annotated[float, OFFSET] = 0.05
    """Maximum sideways shift of the room, for a room of side 2."""
    raise_z: Annotated[Range, SHIFT] = (-0.05, 0.25)
    """Upward shift of the room, for a room of side 2; it varies so that a network cannot learn a
    fixed height of the floor."""
    tilt_deg: Annotated[float, Within(0, 10, unit="degrees")] = 3.0
    """Maximum tilt of a floor or wall out of its plane, in rooms that are not square. The recipes
    allow 10 for open layouts and 3 for the box; parts tilted by 10 must be half as large again for
    their seams to stay closed."""

    def sample_room(self, rng: np.random.Generator, names: Sequence[str]) -> Room:
        """Draw a room with the parts `names`."""
        scale = rng.uniform(*self.scale, size=3)
        shift = rng.uniform(-self.shift, self.shift, size=2)
        translation = np.array([*shift, rng.uniform(*self.raise_z)])
        square = rng.random() < self.square_share
        tilt_deg = 0.0 if square else self.tilt_deg
        patches = {}
        for name in names:
            spin_deg = 90.0 * rng.integers(4) if square else rng.uniform(-180, 180)
            angles_deg = rng.uniform(-tilt_deg, tilt_deg, size=3)
            angles_deg[SIDES[name].axis] = spin_deg
            patches[name] = PatchPlacement(
                rotation_deg=tuple(angles_deg),
                reach=1.0 if square else _covering_reach(spin_deg, tilt_deg),
                scale=tuple(scale),
                translation=tuple(translation),
            )
        return Room(
            patches=patches,
            low=(translation - scale) / 2,
            high=(translation + scale) / 2,
            lean=math.tan(math.radians(tilt_deg)) * float(scale.max()),
        )


def _covering_reach(spin_deg: float, tilt_deg: float) -> float:
    """Half the side of a spun square that covers its side of the room and the seams there.

    A square of half side c covers the unit square if c = |cos| + |sin| of its spin. Two parts that
    are both tilted about two axes meet up to 2 tan(tilt) beyond the edge of an upright room, and
    the tilt shortens a part by its cosine: 3 tan(tilt) covers both.
    """
    spin = math.radians(spin_deg)
    return (abs(math.cos(spin)) + abs(math.sin(spin))) * (1 + 3 * math.tan(math.radians(tilt_deg)))


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
    """Ranges of floor and walls that are drawn independently of each other, as published.

    The `original` policy keeps the spin of a square about its own axis within a few degrees, so
    that the diagonals of its triangulation always run one way, and keeps floors at one height. The
    public recipes repair that (they call it a de-bias): squares spin freely, and floors move. Their
    numbers are in `renderformer_v1`. Parts may leave gaps or cut through each other.
    """

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
        patches = {
            name: getattr(self, name).sample_placement(rng, SIDES[name].axis) for name in names
        }
        return Room(patches=patches, low=np.full(3, -0.5), high=np.full(3, 0.5), lean=0.0)
