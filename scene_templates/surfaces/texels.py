"""The texels of a square map that repeats in both directions, and noise on that torus.

Rows: row 0 is the top, as in every picture of Trilight (storage.conventions). Texture coordinates
run u to the right and v up, so texel (i, j) of a map with N rows is centred on u = (j + 0.5) / N
and v = 1 - (i + 0.5) / N. An EXR, glTF and Mitsuba's arrays have their first row there too; what
flips is v, at the border of each format.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene_templates.exact import NOISE_SCALE, TEXELS_PER_CELL, Numbers, fade


@dataclass(frozen=True)
class Texels:
    """A square map's texels."""

    size: int
    """Width and height in texels."""

    @property
    def u(self) -> Numbers:
        """[1, size] to the right."""
        return (np.arange(self.size)[None, :] + 0.5) / self.size

    @property
    def v(self) -> Numbers:
        """[size, 1] upwards; the first row is the top one."""
        return 1 - (np.arange(self.size)[:, None] + 0.5) / self.size

    def noise(
        self,
        rng: np.random.Generator,
        cells: tuple[int, int],
        *,
        octaves: int = 1,
        moved: tuple[NDArray, NDArray] | None = None,
    ) -> Numbers:
        """Return periodic gradient noise with mean 0, each octave of twice the cells and half.

        The first octave has `cells` in u and in v; there are as many octaves as texels can show.
        The same `rng`, a stream of its own, gives the same noise at every size. `moved` is added to
        u and v before the look-up.
        """
        u, v = (self.u, self.v) if moved is None else (self.u + moved[0], self.v + moved[1])
        total = np.zeros((self.size, self.size))
        gain = NOISE_SCALE
        for _ in range(octaves):
            if TEXELS_PER_CELL * max(cells) > self.size:
                break
            total = total + gain * _gradient_noise(u, v, rng, cells)
            cells, gain = (2 * cells[0], 2 * cells[1]), gain / 2
        return total


def _gradient_noise(
    u: NDArray, v: NDArray, rng: np.random.Generator, cells: tuple[int, int]
) -> Numbers:
    """Return noise that vanishes at the corners of a lattice and has random slopes there.

    Slopes have independent uniform components. Noise is linear in them, so their covariance, which
    prefers no direction, decides its spectrum as that of unit vectors would.
    """
    slopes = 2 * rng.random((cells[1], cells[0], 2)) - 1
    x = u * cells[0]
    y = v * cells[1]
    floor_x = np.floor(x)
    floor_y = np.floor(y)
    x = x - floor_x
    y = y - floor_y
    column = floor_x.astype(np.int64)
    row = floor_y.astype(np.int64)
    across = fade(x)
    up = fade(y)

    def corner(dx: int, dy: int) -> Numbers:
        slope = slopes[(row + dy) % cells[1], (column + dx) % cells[0]]
        return slope[..., 0] * (x - dx) + slope[..., 1] * (y - dy)

    low = corner(0, 0) + (corner(1, 0) - corner(0, 0)) * across
    high = corner(0, 1) + (corner(1, 1) - corner(0, 1)) * across
    return low + (high - low) * up


@dataclass(frozen=True, eq=False)
class Stones:
    """Nearest of many scattered points to each texel, on the torus."""

    index: NDArray[np.int64]
    """[size, size] of the nearest point."""
    nearest: Numbers
    """[size, size] distance to it, in widths of a cell."""
    gap: Numbers
    """[size, size] how much farther the second nearest is: 0 on the border between two."""


def stones(
    texels: Texels,
    rng: np.random.Generator,
    cells: int,
    *,
    jitter: float = 1.0,
    moved: tuple[NDArray, NDArray] | None = None,
) -> Stones:
    """Return the Voronoi cells of one point in each square of a lattice (Worley's noise).

    Args:
        texels: where to look.
        rng: a stream of its own.
        cells: squares per side.
        jitter: how far the points leave the middle of their squares: 1 is anywhere in it.
        moved: what is added to u and v before the look-up.
    """
    offsets = 0.5 + jitter * (rng.random((cells, cells, 2)) - 0.5)
    du, dv = moved if moved is not None else (0.0, 0.0)
    x = (texels.u + du + np.zeros((texels.size, 1))) * cells
    y = (texels.v + dv + np.zeros((1, texels.size))) * cells
    column = np.floor(x).astype(np.int64)
    row = np.floor(y).astype(np.int64)
    first = np.full(x.shape, np.inf)
    second = first.copy()
    index = np.zeros(x.shape, np.int64)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            at = (row + dy) % cells, (column + dx) % cells
            point = offsets[at]
            away_x = column + dx + point[..., 0] - x
            away_y = row + dy + point[..., 1] - y
            square = away_x * away_x + away_y * away_y
            nearer = square < first
            second = np.where(nearer, first, np.minimum(second, square))
            first = np.where(nearer, square, first)
            index = np.where(nearer, at[0] * cells + at[1], index)
    nearest = np.sqrt(first)
    return Stones(index=index, nearest=nearest, gap=np.sqrt(second) - nearest)
