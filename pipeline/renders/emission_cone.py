"""Where light paths set out to: from an emitter outside the scene, into the scene only."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from storage.records.scene import Scene

_MARGIN = 1.001
"""The sphere is too large by this: nothing lies on the rim of a cone, where roundings decide."""


class EmissionCone:
    """Directions into the sphere around all surfaces, uniform over the cone that it fills.

    From inside the sphere: over both sides of the emitter, by the cosine.
    """

    def __init__(self, scene: Scene) -> None:
        corners = scene.vertex_positions[scene.faces[~scene.triangle_emits]].reshape(-1, 3)
        centre = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        radius = _MARGIN * np.linalg.norm(corners - centre, axis=1).max()
        self._centre = mi.Point3f(*(dr.opaque(mi.Float, float(x)) for x in centre))
        self._radius_sq = dr.opaque(mi.Float, float(radius) ** 2)

    def sample(self, position: Any, normal: Any, u: Any) -> Any:
        """Return a unit direction (Vector3f) from a uniform Point2f."""
        axis, height, outside = self._cone(position)
        in_cone = mi.Frame3f(axis).to_world(_cap(height, u))
        side = dr.mulsign(mi.Float(1), u.x - 0.5)
        flat = mi.warp.square_to_cosine_hemisphere(mi.Point2f(dr.abs(2 * u.x - 1), u.y))
        cosine = mi.Frame3f(normal).to_world(flat) * side
        return mi.Vector3f(dr.select(outside, in_cone, cosine))

    def pdf(self, position: Any, normal: Any, direction: Any) -> Any:
        """Return the density (Float, per steradian) with which `sample` draws a direction."""
        axis, height, outside = self._cone(position)
        down = 0.5 * dr.squared_norm(direction - axis)  # 1 - cos, without cancellation
        cap = dr.select(down <= height, 1 / (2 * dr.pi * height), 0)
        return dr.select(outside, cap, dr.abs(dr.dot(normal, direction)) / (2 * dr.pi))

    def _cone(self, position: Any) -> tuple[Any, Any, Any]:
        """Return the axis, 1 - cos of the half angle, and whether there is a cone."""
        to_centre = self._centre - position
        distance_sq = dr.squared_norm(to_centre)
        sine_sq = self._radius_sq / distance_sq
        height = sine_sq / (1 + dr.safe_sqrt(1 - sine_sq))  # no cancellation
        outside = sine_sq < 1
        return mi.Vector3f(to_centre * dr.rsqrt(distance_sq)), height, outside


def _cap(height: Any, u: Any) -> Any:
    down = height * u.x
    radius = dr.safe_sqrt(down * (2 - down))
    sine, cosine = dr.sincos(2 * dr.pi * u.y)
    return mi.Vector3f(radius * cosine, radius * sine, 1 - down)
