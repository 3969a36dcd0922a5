"""The environment map inside a kernel: its radiance in a direction, and directions drawn by it.

A texel is drawn with probability proportional to the light that comes through it, first its row and
then its column (alias tables: two loads each, for any map), and a direction uniformly within it by
solid angle. Radiance is interpolated between texels, so a texel's light is the mean over its area:
a sun of one texel shines into its eight neighbours, and they are drawn by what they have of it.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.device_memory import own_floats
from storage.records.environment import Environment
from storage.records.sky_texels import row_solid_angles, texel_means

_ONE_MINUS_EPSILON = 0.99999994
_TINY = 1e-30


@dataclass(frozen=True, kw_only=True, eq=False)
class SkySample:
    """A direction drawn from a map, lane by lane."""

    direction: Any
    """Unit direction in world space, Vector3f."""
    pdf: Any
    """Density of the direction per steradian, Float; not finite where there is no light."""
    radiance: Any
    """Radiance from the direction, Color3f."""


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
        self._to_world = [_opaque_vector(sky.rotation[:, axis]) for axis in range(3)]
        self._share = dr.opaque(mi.Float, share)
        self._rest = dr.opaque(mi.Float, 1 - share)
        self.is_seen = sky.is_seen
        """True if camera rays that hit nothing see the map."""

    def split_picks(self, u: Any) -> tuple[Any, Any, Any]:
        """Return which picks go to the map (Bool), and the uniform Point2f for map and lamp."""
        last = _ONE_MINUS_EPSILON
        to_sky = dr.minimum(u.x / self._share, last)
        to_lamp = dr.clip((u.x - self._share) / dr.maximum(self._rest, _TINY), 0, last)
        return u.x < self._share, mi.Point2f(to_sky, u.y), mi.Point2f(to_lamp, u.y)

    def of_lamps(self, value: Any) -> Any:
        """Return a density (Float) among lamps as one among all picks."""
        return value * self._rest

    def sample(self, u: Any, active: Any) -> SkySample:
        """Return a direction drawn by the light of the map, from a uniform Point2f."""
        row, down = self._sample_alias(self._rows, mi.UInt32(0), self._height, u.x, active)
        column, along = self._sample_alias(
            self._columns, row * self._width, self._width, u.y, active
        )
        above = dr.gather(mi.Float, self._edges, row, active)
        below = dr.gather(mi.Float, self._edges, row + 1, active)
        z = above + (below - above) * down
        azimuth = (0.5 - (mi.Float(column) + along) / mi.Float(self._width)) * (2 * dr.pi)
        flat = dr.safe_sqrt((1 - z) * (1 + z))
        sine, cosine = dr.sincos(azimuth)
        x, y, up = self._to_world
        direction = mi.Vector3f(dr.normalize(x * (flat * cosine) + y * (flat * sine) + up * z))
        radiance, pdf = self.radiance_and_density(direction, active)
        pdf = dr.select(pdf > 0, pdf, dr.inf)
        return SkySample(direction=direction, pdf=pdf, radiance=radiance)

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

    def _sample_alias(
        self, table: Any, first: Any, count: Any, u: Any, active: Any
    ) -> tuple[Any, Any]:
        """Return an index below `count` drawn from a row of an alias table, and a fresh uniform."""
        scaled = u * mi.Float(count)
        place = dr.minimum(mi.UInt32(scaled), count - 1)
        fraction = scaled - mi.Float(place)
        keep, alias = dr.gather(mi.Vector2f, table, first + place, active)
        keeps = fraction < keep
        chosen = dr.select(keeps, place, mi.UInt32(alias))
        fraction = dr.select(keeps, fraction / keep, (fraction - keep) / (1 - keep))
        return chosen, dr.clip(fraction, 0, _ONE_MINUS_EPSILON)


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


def _opaque_vector(values: NDArray[np.float32]) -> Any:
    return mi.Vector3f(*(dr.opaque(mi.Float, float(value)) for value in values))
