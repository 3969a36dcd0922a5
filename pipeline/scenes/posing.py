"""Brings an asset's mesh to its place in the room: normalise, scale, turn, move, set down."""

import numpy as np
from numpy.typing import NDArray

from scene_templates.layout import Floor, ObjectPlacement
from scene_templates.rotations import rotated

SMALLEST_DOUBLE_AREA = 1e-12
"""A triangle of a square micrometre: no ray meets it, and its normal is rounding."""


def posed(
    positions: NDArray[np.float32], placement: ObjectPlacement, floor: Floor
) -> NDArray[np.float32]:
    """Return the vertices [V, 3] of a mesh in world space.

    As published, the mean of the vertices becomes the centre and the farthest vertex touches the
    sphere of the placement. The mean depends on the tessellation, so that two levels of one asset
    differ a little in size and place. A resting object is lowered along the floor's normal until
    its lowest vertex touches; it need not be in balance.
    """
    centred = positions.astype(np.float64)
    centred -= centred.mean(axis=0)
    reach = np.sqrt(np.sum(np.square(centred), axis=1).max())
    world = rotated(centred * (placement.radius / reach), placement.rotation) + placement.centre
    if placement.rests:
        world -= floor.height(world).min() * floor.normal
    return world.astype(np.float32)


def without_slivers(
    positions: NDArray[np.float32], faces: NDArray[np.uint32]
) -> NDArray[np.uint32]:
    """Return the faces that still have an area after rounding to float32."""
    corners = positions.astype(np.float64)[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return faces[np.sqrt(np.sum(np.square(cross), axis=1)) > SMALLEST_DOUBLE_AREA]
