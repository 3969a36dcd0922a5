"""`PassRays`: what the passes are computed from, and where its points move in the picture."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from storage.conventions import pixel_places
from storage.errors import TrilightError
from storage.raycast.first_hits import FirstHits, corner_table
from storage.records.scene import Scene


@dataclass(frozen=True, eq=False)
class Later:
    """Another moment of a scene, or another camera, that `motion_px` leads to."""

    scene: Scene
    """Has the same triangles with their corners in the same order, possibly elsewhere."""
    view: int
    """Camera index in the later scene."""

    @cached_property
    def corners(self) -> NDArray[np.float64]:
        """[T + 1, 3, 3] positions in metres, the last row NaN."""
        return corner_table(self.scene, self.scene.vertex_positions)


@dataclass(frozen=True, kw_only=True, eq=False)
class PassRays:
    """Rays of a view, with what they meet."""

    hits: FirstHits
    c2w: NDArray[np.float64]
    """[4, 4] of the camera."""
    fov_deg: float
    resolution: int
    """Width and height of the picture in pixels, however many rays a pixel has."""
    later: Later | None


def motion_px(rays: PassRays) -> NDArray[np.float64]:
    """Return where the other camera shows the points that rays meet, less where this one does.

    Returns:
        x to the right and y down [..., 2] in pixels, NaN where nothing is met or where the point
        lies behind the other camera.
    """
    if rays.later is None:
        raise TrilightError("motion_px: no other moment is given; expected `then` or `then_view`.")
    later_scene = rays.later.scene
    view = rays.later.view
    places = pixel_places(
        rays.hits.interpolate(rays.later.corners),
        later_scene.c2w[view],
        float(later_scene.fov_deg[view]),
        rays.resolution,
    )
    return places - pixel_places(rays.hits.position, rays.c2w, rays.fov_deg, rays.resolution)


def require_same_triangles(now: Scene, then: Scene) -> None:
    """Raise TrilightError unless the triangles of two scenes have the same corners, in order."""
    if now.faces.shape != then.faces.shape:
        raise TrilightError(
            f"motion_px: the other scene has {then.num_triangles} triangles; expected the "
            f"{now.num_triangles} of this one, in the same order."
        )
    differ = np.flatnonzero((now.faces != then.faces).any(axis=1))
    if len(differ):
        row = int(differ[0])
        raise TrilightError(
            f"motion_px: faces[{row}] of the other scene is {then.faces[row].tolist()}; expected "
            f"{now.faces[row].tolist()} as in this one, since points are followed by triangles."
        )
