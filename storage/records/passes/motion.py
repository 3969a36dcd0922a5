"""Motion of visible points in the picture, between two moments or two cameras."""

import numpy as np
from numpy.typing import NDArray

from storage.conventions import pixel_places
from storage.errors import TrilightError
from storage.records.passes.rays import PassRays
from storage.records.scene import Scene


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
