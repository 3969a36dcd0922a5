"""The light of an environment by equal parts of the sphere: what tokens are told of a sky.

The parts are those of HEALPix (Gorski et al. 2005): 12 faces of n x n cells, all of one area, 48 or
192 of them. They stand in the axes of the map. So a scene turned together with its map has the
same cells, which point elsewhere: any rotation is exact. A map turned by other means than its
`rotation`, its texels moved, has the same cells only by quarter turns about its axis.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from storage.conventions import latlong_direction
from storage.records.environment import Environment
from storage.records.sky_texels import row_solid_angles

FINEST_ROWS = 256
"""Rows of places at which a map is read at least: a cell of 192 then has 680 of them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SkyCells:
    """An environment in S cells."""

    radiance_S3: NDArray[np.float32]
    """Mean radiance."""
    direction_S3: NDArray[np.float32]
    """Where a cell's light comes from in the mean, world space: about 1 long where all comes from
    one place, less where it comes from all over the cell."""


def sky_cells(sky: Environment, count: int) -> SkyCells:
    """Return the light of a sky in `count` cells, 12 n^2 for a whole n."""
    places = _places(len(sky.radiance_rgb), count)
    radiance = sky.radiance_rgb.reshape(-1, 3)[places.texel_N]

    def sums(values_N: NDArray[np.float64]) -> NDArray[np.float64]:
        found: NDArray[np.float64] = np.bincount(places.cell_N, values_N, count).astype(np.float64)
        return found

    angle_S = sums(places.angle_N)
    light_N3 = radiance * places.angle_N[:, None]
    mean_S3 = np.stack([sums(light_N3[:, c]) for c in range(3)], axis=-1) / angle_S[:, None]
    weight_N = np.sort(light_N3, axis=-1).sum(axis=-1)  # sorted: the order of colours is no matter
    dark_S = sums(weight_N) == 0
    weight_N = np.where(dark_S[places.cell_N], places.angle_N, weight_N)
    along_S3 = np.stack([sums(weight_N * places.direction_N3[:, c]) for c in range(3)], axis=-1)
    along_S3 /= sums(weight_N)[:, None]
    return SkyCells(
        radiance_S3=mean_S3.astype(np.float32),
        direction_S3=(along_S3 @ sky.rotation.astype(np.float64).T).astype(np.float32),
    )


def cell_of(direction: NDArray[np.float64], count: int) -> NDArray[np.intp]:
    """Return the cell of each unit direction [N, 3], from 0 to count - 1."""
    side = math.isqrt(count // 12)
    x, y, z = np.moveaxis(direction, -1, 0)
    quarter = np.arctan2(y, x) / (np.pi / 2) % 4
    # around the equator: lines that rise and lines that fall, evenly spaced in azimuth and z
    falling = np.floor(side * (0.5 + quarter - 0.75 * z)).astype(np.intp)
    rising = np.floor(side * (0.5 + quarter + 0.75 * z)).astype(np.intp)
    first, second = falling // side, rising // side
    face = np.where(first == second, first % 4 + 4, np.where(first < second, first, second + 8))
    column, row = rising % side, side - 1 - falling % side
    # around the poles: the same lines, which meet there
    face_p = np.minimum(quarter.astype(np.intp), 3)
    within = quarter - face_p
    down = side * np.sqrt(np.maximum(3 * (1 - np.abs(z)), 0))
    a = np.minimum((within * down).astype(np.intp), side - 1)
    b = np.minimum(((1 - within) * down).astype(np.intp), side - 1)
    north = z > 0
    face = np.where(np.abs(z) <= 2 / 3, face, np.where(north, face_p, face_p + 8))
    column = np.where(np.abs(z) <= 2 / 3, column, np.where(north, side - 1 - b, a))
    row = np.where(np.abs(z) <= 2 / 3, row, np.where(north, side - 1 - a, b))
    cells: NDArray[np.intp] = (face * side + row) * side + column
    return cells


@dataclass(frozen=True, kw_only=True, eq=False)
class _Places:
    """N places at which a map is read."""

    texel_N: NDArray[np.intp]
    cell_N: NDArray[np.intp]
    angle_N: NDArray[np.float64]
    """Steradians."""
    direction_N3: NDArray[np.float64]
    """In the axes of the map."""


@lru_cache(maxsize=8)
def _places(height: int, count: int) -> _Places:
    """Return the middles of all parts of texels; texels of small maps have several parts."""
    parts = -(-FINEST_ROWS // height)
    rows = parts * height
    row, column = (each.ravel() for each in np.indices((rows, 2 * rows)))
    u, v = (column + 0.5) / (2 * rows), 1 - (row + 0.5) / rows
    direction = latlong_direction(np.stack([u, v], axis=-1))
    return _Places(
        texel_N=row // parts * 2 * height + column // parts,
        cell_N=cell_of(direction, count),
        angle_N=row_solid_angles(rows)[row],
        direction_N3=direction,
    )
