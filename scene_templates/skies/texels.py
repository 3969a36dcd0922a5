"""Texels of a latitude-longitude (equirectangular) map, and shapes and noise on it.

Orientation is that of Trilight's environment maps and of Blender: +Z is up, the first row is the
top, the middle of the picture is +X, a quarter from its left edge is +Y, its edges are -X. Texel
(i, j) of H rows and 2 H columns is centred on u = (j + 0.5) / 2H and v = 1 - (i + 0.5) / H, and
looks at azimuth (0.5 - u) 2 pi, from +X towards +Y, and elevation (v - 0.5) pi.
"""

import functools
import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene_templates.exact import (
    NOISE_SCALE,
    TEXELS_PER_CELL,
    Numbers,
    cosine,
    dot,
    fade,
    ramp,
    sine,
)

LATTICE = 32
"""Cells after which noise in space repeats; the coarse octaves do not reach it."""

SPOT_RADIUS = 1.5
"""Radius of a spot in rows: the nearest texel centre is always inside."""


@dataclass(frozen=True)
class SkyTexels:
    """The texels of a map with `height` rows and twice as many columns."""

    height: int
    """Rows; a row is pi / height high."""

    @functools.cached_property
    def directions(self) -> Numbers:
        """[H, 2H, 3] unit vectors at the centres; read-only."""
        height = self.height
        elevation = (0.5 - (np.arange(height)[:, None] + 0.5) / height) * np.pi
        azimuth = (0.5 - (np.arange(2 * height)[None, :] + 0.5) / (2 * height)) * 2 * np.pi
        flat = np.zeros((height, 2 * height))
        across = cosine(elevation)
        directions = np.stack(
            [across * cosine(azimuth), across * sine(azimuth), sine(elevation) + flat], axis=-1
        )
        directions.setflags(write=False)
        return directions

    @property
    def z(self) -> Numbers:
        """[H, 1] sine of the elevation."""
        return self.directions[:, :1, 2]

    @functools.cached_property
    def solid_angle(self) -> Numbers:
        """[H, 1] steradians of each texel of a row, in sum 4 pi over all texels; read-only."""
        edges = sine((0.5 - np.arange(self.height + 1) / self.height) * np.pi)
        solid_angle_sr = ((edges[:-1] - edges[1:]) * np.pi / self.height)[:, None]
        solid_angle_sr.setflags(write=False)
        return solid_angle_sr

    def flux(self, radiance: NDArray) -> Numbers:
        """Return the integral over the sphere of a map [H, 2H] or [H, 2H, 3]."""
        weight = self.solid_angle if radiance.ndim == 2 else self.solid_angle[..., None]
        return _sum(radiance * weight)

    def irradiance(self, radiance: NDArray) -> Numbers:
        """Return what a map [H, 2H, 3] sends onto a horizontal plane from above, [3]."""
        weight = self.solid_angle * np.maximum(self.z, 0)
        return _sum(radiance * weight[..., None])

    def lobe(self, towards: NDArray, sharpness: float) -> Numbers:
        """Return a round glow of unit flux [H, 2H]: 1 / (1 + sharpness (1 - cos angle))^2.

        Half of its light comes from where sharpness (1 - cos angle) is below about 1.
        """
        below = 1 + sharpness * (1 - dot(self.directions, towards))
        return self.of_unit_flux(1 / (below * below), towards)

    def spot(self, towards: NDArray) -> Numbers:
        """Return a spot of unit flux [H, 2H], brightest in the middle, 0 beyond its radius."""
        reach = 1 - float(cosine(min(1.0, SPOT_RADIUS / self.height) * np.pi))
        inside = 1 - (1 - dot(self.directions, towards)) / reach
        falloff = np.maximum(inside, 0)
        return falloff / self.flux(falloff)

    def pane(
        self,
        towards: NDArray,
        half_sizes: tuple[float, float],
        *,
        roll_rad: float = 0.0,
        panes: tuple[int, int] = (1, 1),
        bars: float = 0.0,
    ) -> Numbers:
        """Return how much of each texel [H, 2H] a rectangle covers, whose middle is `towards` [3].

        It has half of its width and height at distance 1, is turned about its middle, and divided
        into columns and rows of panes. The width of the bars between and around them is a share of
        a pane.
        """
        right, up = _axes(towards, roll_rad)
        ahead = dot(self.directions, towards)
        depth = np.maximum(ahead, 1e-9)
        covered = (ahead > 0).astype(np.float64)
        for axis, half, count in zip((right, up), half_sizes, panes, strict=True):
            across = (dot(self.directions, axis) / depth / half + 1) / 2 * count
            place = np.clip(np.floor(across), 0, count - 1)
            edge = 0.5 - np.abs(across - place - 0.5) - bars / 2
            covered = covered * ramp(edge * 2 * half / count * self.height / np.pi)
        return covered

    def noise(self, rng: np.random.Generator, cells: float, *, octaves: int = 1) -> Numbers:
        """Return noise [H, 2H] of mean 0, the same everywhere on the sphere: no seam and no poles.

        It is gradient noise in space, looked up on the sphere; each octave has half the amplitude.

        Args:
            rng: a stream of its own.
            cells: of the first octave along a radius.
            octaves: how many, as far as texels can show them.
        """
        total = np.zeros((self.height, 2 * self.height))
        gain = NOISE_SCALE
        for _ in range(octaves):
            if TEXELS_PER_CELL * np.pi * cells > self.height:
                break
            total = total + gain * _noise_in_space(self.directions * cells, rng)
            cells, gain = 2 * cells, gain / 2
        return total

    def of_unit_flux(self, shape: NDArray, towards: NDArray) -> Numbers:
        """Return a shape [H, 2H] with unit flux; a spot where it fell between all texels."""
        flux = float(self.flux(shape))
        return shape / flux if flux > 0 else self.spot(towards)


texels_of = functools.lru_cache(maxsize=2)(SkyTexels)
"""Returns the texels of a height, the same ones while few heights are asked for."""


def _sum(values: NDArray) -> Numbers:
    """Return the sum over rows and columns, by rows first: the same order on every processor."""
    return np.add.accumulate(np.add.accumulate(values, axis=1)[:, -1], axis=0)[-1]


def _axes(towards: NDArray, roll_rad: float) -> tuple[Numbers, Numbers]:
    """Return two unit vectors across a direction; without a roll, the first one is level."""
    x, y, z = towards
    level = np.array([-y, x, 0.0]) if abs(z) < 0.999 else np.array([0.0, 1.0, 0.0])
    upright = np.cross(towards, level)
    level, upright = (axis / np.sqrt(dot(axis, axis)) for axis in (level, upright))
    turn_cos = float(cosine(roll_rad))
    turn_sin = float(sine(roll_rad))
    return turn_cos * level + turn_sin * upright, turn_cos * upright - turn_sin * level


def _noise_in_space(points: NDArray, rng: np.random.Generator) -> Numbers:
    """Return gradient noise at points [..., 3], of a lattice that repeats after LATTICE cells."""
    slopes = 2 * rng.random((3, LATTICE**3)) - 1
    axes = [np.ascontiguousarray(points[..., axis]) for axis in range(3)]
    corners = [np.floor(axis) for axis in axes]
    insides = [axis - corner for axis, corner in zip(axes, corners, strict=True)]
    fades = [fade(x) for x in insides]
    total = np.zeros(points.shape[:-1])
    for steps in itertools.product((0, 1), repeat=3):
        place = np.zeros(total.shape, np.int64)
        weight = np.ones_like(total)
        height = np.zeros_like(total)
        for corner, step, faded in zip(corners, steps, fades, strict=True):
            place = place * LATTICE + (corner.astype(np.int64) + step) % LATTICE
            weight = weight * (faded if step else 1 - faded)
        for slope, inside, step in zip(slopes, insides, steps, strict=True):
            height = height + slope[place] * (inside - step)
        total = total + height * weight
    return total
