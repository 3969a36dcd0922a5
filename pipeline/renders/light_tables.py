"""Light sampling: all emitting triangles as one table, and an environment map as another.

A triangle is picked with probability proportional to area x mean radiance (an alias table, Walker
1977: two loads for 1 or for 1000 emitters), then a point uniformly on it. Both sides emit, so there
is no cosine test. Mitsuba itself picks emitters by static weights and compiles a new kernel for
each number of them; its `area` emitter has one side.

A texel of a map is drawn with probability proportional to the light that comes through it, first
its row and then its column (alias tables: two loads each, for any map), and a direction uniformly
within it by solid angle. Radiance is interpolated between texels, so a texel's light is the mean
over its area: a sun of one texel shines into its eight neighbours, and they are drawn by what they
have of it.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.device_memory import opaque_vector, own_floats
from pipeline.renders.surface_table import SurfacePoint, neighbours
from storage.errors import Rejected
from storage.records.material import EMISSION
from storage.records.scene import Scene
from storage.records.texture import Environment, row_solid_angles, texel_means

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
        if not power.sum() > 0:
            if not may_be_dark:
                count = len(order) if lit is None else int(lit.sum())
                raise Rejected("unlit_scene", f"{count} emitting triangles have no area")
            self._rows = own_floats(np.zeros((max(len(order), 1), 16)))
            self._alias = own_floats(np.column_stack([np.ones(1), np.zeros(1)]))
            self._count = dr.opaque(mi.UInt32, 1)
            return
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
        down = height * u.x
        radius = dr.safe_sqrt(down * (2 - down))
        sine, cosine = dr.sincos(2 * dr.pi * u.y)
        cap = mi.Vector3f(radius * cosine, radius * sine, 1 - down)
        in_cone = mi.Frame3f(axis).to_world(cap)
        side = dr.mulsign(mi.Float(1), u.x - 0.5)
        flat = mi.warp.square_to_cosine_hemisphere(mi.Point2f(dr.abs(2 * u.x - 1), u.y))
        by_cosine = mi.Frame3f(normal).to_world(flat) * side
        return mi.Vector3f(dr.select(outside, in_cone, by_cosine))

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


_TINY = 1e-30


class SkyTable:
    """The map of a scene. Not a dataclass: Dr.Jit would take its arrays for loop variables."""

    def __init__(self, sky: Environment, share: float) -> None:
        """Build the table.

        Args:
            sky: a map that is not all black.
            share: of the picks that go to it, the others going to lamps; above 0, at most 1.
        """
        height, width = sky.radiance_rgb.shape[:2]
        angles = row_solid_angles(height)
        flux = texel_means(sky.radiance_rgb.mean(axis=-1, dtype=np.float64)) * angles[:, None]
        rows = flux.sum(axis=1)
        pdf = flux / rows.sum() / angles[:, None]
        self._texels = own_floats(np.concatenate([sky.radiance_rgb, pdf[..., None]], axis=-1))
        self._rows = own_floats(np.stack(alias_rows(rows[None]), axis=-1))
        self._columns = own_floats(np.stack(alias_rows(flux), axis=-1))
        self._edges = own_floats(np.cos(np.pi * np.arange(height + 1) / height))
        self._height, self._width = (dr.opaque(mi.UInt32, side) for side in (height, width))
        self._to_world = [opaque_vector(sky.rotation[:, axis]) for axis in range(3)]
        self._share = dr.opaque(mi.Float, share)
        self.rest = dr.opaque(mi.Float, 1 - share)
        """Share of the lamps, Float: a density among them times this is one among all picks."""
        self.is_seen = sky.is_seen
        """True if camera rays that hit nothing see the map."""

    def split_picks(self, u: Any) -> tuple[Any, Any, Any]:
        """Return which picks go to the map (Bool), and the uniform Point2f for map and lamp."""
        last = ONE_MINUS_EPSILON
        to_sky = dr.minimum(u.x / self._share, last)
        to_lamp = dr.clip((u.x - self._share) / dr.maximum(self.rest, _TINY), 0, last)
        return u.x < self._share, mi.Point2f(to_sky, u.y), mi.Point2f(to_lamp, u.y)

    def sample(self, u: Any, active: Any) -> tuple[Any, Any, Any]:
        """Return a direction drawn by the light of the map, from a uniform Point2f.

        Returns:
            Unit direction in world space, Vector3f; its density per steradian, Float, not finite
            where there is no light; and the radiance that comes from it, Color3f.
        """
        row, down = sample_alias(self._rows, mi.UInt32(0), self._height, u.x, active)
        column, along = sample_alias(self._columns, row * self._width, self._width, u.y, active)
        above = dr.gather(mi.Float, self._edges, row, active)
        below = dr.gather(mi.Float, self._edges, row + 1, active)
        z = above + (below - above) * down
        azimuth = (0.5 - (mi.Float(column) + along) / mi.Float(self._width)) * (2 * dr.pi)
        flat = dr.safe_sqrt((1 - z) * (1 + z))
        sine, cosine = dr.sincos(azimuth)
        x, y, up = self._to_world
        direction = mi.Vector3f(dr.normalize(x * (flat * cosine) + y * (flat * sine) + up * z))
        radiance, pdf = self.radiance_and_density(direction, active)
        return direction, dr.select(pdf > 0, pdf, dr.inf), radiance

    def radiance_and_density(self, direction: Any, active: Any) -> tuple[Any, Any]:
        """Return the radiance (Color3f) that comes from a unit direction of the world.

        The second is the density (Float, per steradian) with which a pick, of a lamp or of the map,
        is this direction.
        """
        x, y, z = (dr.dot(axis, direction) for axis in self._to_world)
        u = 0.5 - dr.atan2(y, x) / (2 * dr.pi)
        v = dr.atan2(dr.sqrt(x * x + y * y), z) / dr.pi
        *columns, along = neighbours(u, self._width)
        columns = [dr.minimum(c, self._width - 1) for c in columns]  # of what is no direction
        place = v * mi.Float(self._height) - 0.5
        above = dr.floor(place)
        down = place - above
        most = mi.Int32(self._height) - 1
        rows = [mi.UInt32(dr.clip(mi.Int32(above) + step, 0, most)) for step in (0, 1)]
        upper, lower = (
            [
                dr.gather(mi.Vector4f, self._texels, row * self._width + column, active)
                for column in columns
            ]
            for row in rows
        )
        above, below = (dr.lerp(row[0], row[1], along) for row in (upper, lower))
        mean = dr.lerp(above, below, down)
        nearest = dr.select(down < 0.5, *(dr.select(along < 0.5, *row) for row in (upper, lower)))
        return mi.Color3f(mean.xyz), nearest.w * self._share


def alias_rows(weights: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Return an alias table for each row of weights [N, C]; a row without weight is even.

    Each column keeps a part of what falls to it, and the rest goes to another column. All rows are
    worked off at once, one column in each step (the sweep of Huebschle-Schneider and Sanders 2022).
    """
    count = weights.shape[1]
    total = weights.sum(axis=1, keepdims=True)
    even = np.ones_like(weights)
    scaled = np.divide(weights * count, total, out=even, where=total > 0)
    keep = np.ones_like(scaled)
    alias = np.tile(np.arange(count), (len(scaled), 1))
    order = np.argsort(scaled >= 1, axis=1, kind="stable")  # the poor columns, then the rich
    poor = np.zeros(len(scaled), np.intp)
    all_rows = np.arange(len(scaled))
    num_poor = (scaled < 1).sum(axis=1)
    rich = num_poor.copy()
    residual = scaled[all_rows, order[all_rows, np.minimum(rich, count - 1)]]
    for _ in range(count):
        going = (poor < num_poor) & (rich < count)
        from_rich = going & (residual >= 1)
        rich_column = order[all_rows, np.minimum(rich, count - 1)]
        poor_column = order[all_rows, np.minimum(poor, count - 1)]
        rows = all_rows[from_rich]
        columns = poor_column[from_rich]
        keep[rows, columns] = scaled[rows, columns]
        alias[rows, columns] = rich_column[from_rich]
        residual = np.where(from_rich, residual - (1 - scaled[all_rows, poor_column]), residual)
        poor += from_rich
        used_up = ~from_rich & (rich < count - 1) & (residual < 1)
        following = order[all_rows, np.minimum(rich + 1, count - 1)]
        rows = all_rows[used_up]
        columns = rich_column[used_up]
        keep[rows, columns] = residual[used_up]
        alias[rows, columns] = following[used_up]
        residual = np.where(used_up, residual + scaled[all_rows, following] - 1, residual)
        rich += used_up
    return np.clip(keep, 0, 1), alias


def sky_share(scene: Scene, sky: Environment) -> float:
    """Return the share of the picks that go to the environment: above 0, and 1 without lamps.

    Lamps weigh area x radiance. In that unit a map weighs 2 pi R^2 times its mean radiance, with R
    the radius of the sphere around the bounding box of all surfaces. But most of a smooth map is
    found by directions that the surface draws, and samples that pick it are taken from the lamps:
    picked by its whole power, a bright constant map had twice the error. So a map weighs what it
    has in peaks, its mean less its median, and at least as much as the average lamp (study S29).
    """
    power = lamp_power(scene)
    lamps = len(np.unique(scene.object_index[scene.triangle_emits]))
    if not power > 0:
        return 1.0
    corners = scene.vertex_positions[scene.faces[~scene.triangle_emits]].reshape(-1, 3)
    radius = float(0.5 * np.linalg.norm(np.ptp(corners.astype(np.float64), axis=0)))
    weight = max(2 * np.pi * radius**2 * peaked_radiance(sky), power / lamps)
    return float(weight / (weight + power))


def lamp_power(scene: Scene) -> float:
    """Return the sum over emitting triangles of area x mean radiance of the three channels."""
    emits = scene.triangle_emits
    radiance = scene.materials[scene.material_index[emits]][:, EMISSION].astype(np.float64)
    return float((triangle_areas(scene, emits)[3] * radiance.mean(axis=1)).sum())


def peaked_radiance(sky: Environment) -> float:
    """Return the mean radiance of a map over the sphere, less its median over the sphere."""
    grey = sky.radiance_rgb.mean(axis=-1, dtype=np.float64)
    weight = np.broadcast_to(row_solid_angles(len(grey))[:, None], grey.shape) / (4 * np.pi)
    order = np.argsort(grey, axis=None, kind="stable")
    below = np.cumsum(weight.ravel()[order])
    median = grey.ravel()[order][min(np.searchsorted(below, 0.5), len(order) - 1)]
    return max(0.0, float((grey * weight).sum() - median))
