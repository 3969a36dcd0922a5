"""Light sampling: all emitting triangles as one table, picked by power in constant time.

A triangle is picked with probability proportional to area x mean radiance (an alias table, Walker
1977: two loads for 1 or for 1000 emitters), then a point uniformly on it. Both sides emit, so there
is no cosine test. Mitsuba itself picks emitters by static weights and compiles a new kernel for
each number of them; its `area` emitter has one side.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.device_memory import opaque_vector, own_floats
from pipeline.renders.surface_table import SurfacePoint
from storage.errors import Rejected
from storage.records.material import EMISSION
from storage.records.scene import Scene

ONE_MINUS_EPSILON = 0.99999994


@dataclass(frozen=True, kw_only=True, eq=False)
class EmitterPoint(SurfacePoint):
    """A sampled point on an emitter, lane by lane; the side of its normal does not matter."""

    area_pdf: Any
    """Probability of this point among all emitters, Float per square meter."""
    radiance: Any
    """Emitted radiance, Color3f; equal in all directions."""


class EmitterTable:
    """The emitting triangles `order` of a scene, in that order."""

    def __init__(
        self,
        scene: Scene,
        order: NDArray[np.intp],
        lit: NDArray[np.bool_] | None = None,
        *,
        may_be_dark: bool = False,
    ) -> None:
        """Build the table.

        Args:
            order: rows of its emitting triangles.
            lit: which of `order` are switched on; all by default. The others stay black bodies.
            may_be_dark: whether something else lights the scene, so that a table of no light will
                do; it gives points of no density and no radiance.

        Raises:
            Rejected: "unlit_scene" where no emitter that is on has both area and radiance.
        """
        corner, edge1, edge2, area = triangle_areas(scene, order)
        radiance = scene.materials[scene.material_index[order]][:, EMISSION].astype(np.float64)
        if lit is not None:
            radiance *= lit[:, None]
        power = area * radiance.mean(axis=1)
        if not power.sum() > 0 and may_be_dark:
            self._rows = own_floats(np.zeros((max(len(order), 1), 16)))
            self._alias = own_floats(np.column_stack([np.ones(1), np.zeros(1)]))
            self._count = dr.opaque(mi.UInt32, 1)
            return
        if not power.sum() > 0:
            count = len(order) if lit is None else int(lit.sum())
            raise Rejected("unlit_scene", f"{count} emitting triangles have no area")
        share = power / power.sum()
        pdf = np.divide(share, area, out=np.zeros_like(area), where=area > 0)
        keep, alias = alias_table(share)
        nothing = np.zeros(len(order))
        rows = np.column_stack([corner, pdf, edge1, nothing, edge2, nothing, radiance, nothing])
        self._rows = own_floats(rows)
        self._alias = own_floats(np.column_stack([keep, alias]))
        self._count = dr.opaque(mi.UInt32, len(order))

    def sample(self, u: Any, active: Any) -> EmitterPoint:
        """Return a point drawn by power, from a uniform Point2f."""
        row, fraction = sample_alias(self._alias, mi.UInt32(0), self._count, u.x, active)
        corner, edge1, edge2, radiance = (self._group(row, group, active) for group in range(4))
        edge1 = mi.Vector3f(edge1.xyz)
        edge2 = mi.Vector3f(edge2.xyz)
        weights = mi.warp.square_to_uniform_triangle(mi.Point2f(fraction, u.y))
        return EmitterPoint(
            position=mi.Point3f(mi.Point3f(corner.xyz) + edge1 * weights.x + edge2 * weights.y),
            geometric_normal=dr.normalize(dr.cross(edge1, edge2)),
            area_pdf=corner.w,
            radiance=mi.Color3f(radiance.xyz),
        )

    def pdf_and_radiance(self, row: Any, active: Any) -> tuple[Any, Any]:
        """Return the probability per area (Float) and the radiance (Color3f) of an emitter."""
        radiance = self._group(row, 3, active)
        return self._group(row, 0, active).w, mi.Color3f(radiance.xyz)

    def _group(self, row: Any, group: int, active: Any) -> Any:
        return dr.gather(mi.Vector4f, self._rows, row * 4 + group, active)


def triangle_areas(scene: Scene, rows: NDArray[Any]) -> tuple[NDArray[np.float64], ...]:
    """Return the first corner, both edges from it, and the area of some triangles."""
    corners = scene.vertex_positions[scene.faces[rows]].astype(np.float64)
    edge1 = corners[:, 1] - corners[:, 0]
    edge2 = corners[:, 2] - corners[:, 0]
    return corners[:, 0], edge1, edge2, 0.5 * np.linalg.norm(np.cross(edge1, edge2), axis=1)


def sample_alias(table: Any, first: Any, count: Any, u: Any, active: Any) -> tuple[Any, Any]:
    """Return an index below `count` drawn from an alias table, and a fresh uniform (Float).

    Args:
        table: rows of what each column keeps, and the column that the rest goes to (Float).
        first: UInt32, the row of the table's first column.
        count: UInt32, its columns.
        u: Float, uniform.
        active: Bool.
    """
    scaled = u * mi.Float(count)
    column = dr.minimum(mi.UInt32(scaled), count - 1)
    fraction = scaled - mi.Float(column)
    keep, alias = dr.gather(mi.Vector2f, table, first + column, active)
    keeps = fraction < keep
    chosen = dr.select(keeps, column, mi.UInt32(alias))
    fraction = dr.select(keeps, fraction / keep, (fraction - keep) / (1 - keep))
    return chosen, dr.clip(fraction, 0, ONE_MINUS_EPSILON)


def alias_table(share: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Return for each column the part that it keeps and the row that the rest goes to."""
    keep = share * len(share)
    alias = np.arange(len(share))
    small = [row for row in range(len(share)) if keep[row] < 1]
    large = [row for row in range(len(share)) if keep[row] >= 1]
    while small and large:
        poor = small.pop()
        rich = large[-1]
        alias[poor] = rich
        keep[rich] -= 1 - keep[poor]
        if keep[rich] < 1:
            small.append(large.pop())
    keep[[*small, *large]] = 1  # what is left over is 1 up to rounding
    return keep, alias


_MARGIN = 1.001
"""The sphere is too large by this: nothing lies on the rim of a cone, where roundings decide."""


class EmissionCone:
    """Directions in which light paths leave an emitter: into the sphere around all surfaces only.

    They are uniform over the cone that the sphere fills; from inside of it, by the cosine over both
    sides of the emitter.
    """

    def __init__(self, scene: Scene) -> None:
        corners = scene.vertex_positions[scene.faces[~scene.triangle_emits]].reshape(-1, 3)
        centre = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        radius = _MARGIN * np.linalg.norm(corners - centre, axis=1).max()
        self._centre = mi.Point3f(opaque_vector(centre))
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
