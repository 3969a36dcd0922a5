"""Flat patches of 128 triangles, and where the four parts of a shell stand.

The order of transforms is the published one: turn about X, Y, Z, scale per axis, move, halve.
"""

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from scene_templates.rotations import rotated, rotation_xyz

QUADS = 8
"""Quads per side of a patch: 8 x 8 x 2 = 128 triangles."""


@dataclass(frozen=True, kw_only=True)
class Side:
    """One side of the nominal room, the cube [-1, 1]^3 before halving."""

    axis: int
    """The axis that the side is perpendicular to."""
    sign: int
    """At which end of that axis it stands."""


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
    """How a patch is brought from its side of the nominal room to its place."""

    rotation_deg: tuple[float, float, float]
    """About X, then Y, then Z, through the middle of the room; the angle about the side's own
    axis spins the patch in its plane."""
    reach: float
    """Half the side of the square; 1 fills the side of the nominal room exactly."""
    scale: tuple[float, float, float]
    """Per axis."""
    translation: tuple[float, float, float]
    """After scaling."""


def patch(side: Side, placement: PatchPlacement) -> NDArray[np.float64]:
    """Return the vertices [81, 3] of a patch in world units; `PATCH_FACES` joins them."""
    line = np.linspace(-placement.reach, placement.reach, QUADS + 1)
    u, v = (grid.ravel() for grid in np.meshgrid(line, line, indexing="ij"))
    local = np.zeros((len(u), 3))
    # The two axes in the plane, in the order that makes u x v point into the room.
    first, second = (side.axis + 1) % 3, (side.axis + 2) % 3
    local[:, first], local[:, second] = (v, u) if side.sign > 0 else (u, v)
    local[:, side.axis] = side.sign
    turned = rotated(local, rotation_xyz(placement.rotation_deg))
    return (turned * placement.scale + placement.translation) / 2


def _patch_faces() -> NDArray[np.uint32]:
    rows = np.arange((QUADS + 1) ** 2, dtype=np.uint32).reshape(QUADS + 1, QUADS + 1)
    a, b, c, d = (rows[:-1, :-1], rows[1:, :-1], rows[1:, 1:], rows[:-1, 1:])
    pairs = np.stack([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)], axis=2)
    return pairs.reshape(-1, 3)


PATCH_FACES = _patch_faces()
"""[128, 3], counter-clockwise seen from the room."""
PATCH_FACES.setflags(write=False)
