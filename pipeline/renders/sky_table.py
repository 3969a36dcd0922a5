"""The environment map inside a kernel: its radiance, and importance sampling of directions.

A texel is drawn with probability proportional to the light that comes through it, first its row and
then its column (alias tables: two loads each, for any map), and a direction uniformly within it by
solid angle. Radiance is interpolated between texels, so a texel's light is the mean over its area:
a sun of one texel shines into its eight neighbours, and they are drawn by what they have of it.
"""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.device_memory import opaque_vector, own_floats
from pipeline.renders.emitter_table import ONE_MINUS_EPSILON, sample_alias, triangle_areas
from storage.records.environment import Environment, row_solid_angles, texel_means
from storage.records.material import EMISSION
from storage.records.scene import Scene

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
        first_column, along = _between(u * mi.Float(self._width))
        above, down = _between(v * mi.Float(self._height))
        most = mi.Int32(self._height) - 1
        rows = [mi.UInt32(dr.clip(above + step, 0, most)) for step in (0, 1)]
        width = mi.Int32(self._width)
        columns = [first_column + step for step in (0, 1)]
        columns = [mi.UInt32(dr.select(c < 0, c + width, c)) for c in columns]
        columns = [dr.select(c >= self._width, c - self._width, c) for c in columns]
        columns = [dr.minimum(c, self._width - 1) for c in columns]  # of what is no direction
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


def _between(place: Any) -> tuple[Any, Any]:
    """Return the texel centre (Int32) at or before a place in texels, and how far it is beyond."""
    shifted = place - 0.5
    before = dr.floor(shifted)
    return mi.Int32(before), shifted - before


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
