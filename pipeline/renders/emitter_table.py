"""All emitting triangles as one table: picked by power, in constant time, whatever their number.

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

from pipeline.renders.device_memory import own_floats
from storage.errors import Rejected
from storage.records.material import EMISSION
from storage.records.scene import Scene

_ONE_MINUS_EPSILON = 0.99999994


@dataclass(frozen=True, kw_only=True, eq=False)
class EmitterPoint:
    """A sampled point on an emitter, lane by lane."""

    position: Any
    """Position on the triangle, Point3f in meters."""
    normal: Any
    """Vector3f, unit; its side does not matter."""
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
            scene: the scene.
            order: rows of its emitting triangles.
            lit: which of `order` are switched on; all by default. The others stay black bodies.
            may_be_dark: whether something else lights the scene, so that a table of no light will
                do; it gives points of no density and no radiance.

        Raises:
            Rejected: "unlit_scene" where no emitter that is on has both area and radiance.
        """
        corners = scene.vertex_positions[scene.faces[order]].astype(np.float64)
        radiance = scene.materials[scene.material_index[order]][:, EMISSION].astype(np.float64)
        if lit is not None:
            radiance *= lit[:, None]
        edge1 = corners[:, 1] - corners[:, 0]
        edge2 = corners[:, 2] - corners[:, 0]
        area = 0.5 * np.linalg.norm(np.cross(edge1, edge2), axis=1)
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
        rows = np.column_stack(
            [corners[:, 0], pdf, edge1, nothing, edge2, nothing, radiance, nothing]
        )
        self._rows = own_floats(rows)
        self._alias = own_floats(np.column_stack([keep, alias]))
        self._count = dr.opaque(mi.UInt32, len(order))

    def sample(self, u: Any, active: Any) -> EmitterPoint:
        """Return a point drawn by power, from a uniform Point2f."""
        scaled = u.x * mi.Float(self._count)
        column = dr.minimum(mi.UInt32(scaled), self._count - 1)
        fraction = scaled - mi.Float(column)
        keep, alias = dr.gather(mi.Vector2f, self._alias, column, active)
        keeps = fraction < keep
        row = dr.select(keeps, column, mi.UInt32(alias))
        fraction = dr.select(keeps, fraction / keep, (fraction - keep) / (1 - keep))
        fraction = dr.clip(fraction, 0, _ONE_MINUS_EPSILON)
        corner, edge1, edge2, radiance = (self._group(row, group, active) for group in range(4))
        edge1 = mi.Vector3f(edge1.xyz)
        edge2 = mi.Vector3f(edge2.xyz)
        weights = mi.warp.square_to_uniform_triangle(mi.Point2f(fraction, u.y))
        return EmitterPoint(
            position=mi.Point3f(mi.Point3f(corner.xyz) + edge1 * weights.x + edge2 * weights.y),
            normal=dr.normalize(dr.cross(edge1, edge2)),
            area_pdf=corner.w,
            radiance=mi.Color3f(radiance.xyz),
        )

    def pdf_and_radiance(self, row: Any, active: Any) -> tuple[Any, Any]:
        """Return the probability per area (Float) and the radiance (Color3f) of an emitter."""
        radiance = self._group(row, 3, active)
        return self._group(row, 0, active).w, mi.Color3f(radiance.xyz)

    def _group(self, row: Any, group: int, active: Any) -> Any:
        return dr.gather(mi.Vector4f, self._rows, row * 4 + group, active)


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
