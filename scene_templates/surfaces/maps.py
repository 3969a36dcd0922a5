"""`SurfaceMaps`: a textured surface, with the texels, noise and finishes that it is drawn with.

A map is square and repeats in both directions, as on a torus. Row 0 is the top, as in every picture
of Trilight (storage.conventions). Texture coordinates run u to the right and v up, so texel (i, j)
of a map with N rows is centred on u = (j + 0.5) / N and v = 1 - (i + 0.5) / N. An EXR, glTF and
Mitsuba's arrays have their first row there too; what flips is v, at the border of each format.
"""

from dataclasses import dataclass, replace
from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scene_templates.exact import NOISE_SCALE, TEXELS_PER_CELL, Numbers, fade, lerp
from scene_templates.layout import RGB
from scene_templates.recorded_sampler import RecordedSampler
from storage.records.texture import MapSource


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


MOST_ALBEDO = 0.95
"""Greatest channel of a base colour and greatest specular share: no surface is whiter, and the sum
of both albedos stays below 1 by far more than float32 rounds."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceMaps:
    """A surface that repeats in both directions, in linear colour. What is drawn is square."""

    diffuse_rgb: NDArray[np.float32]
    """[H, W, 3] diffuse albedo; with the specular one at most 1 in each channel."""
    specular_rgb: NDArray[np.float32]
    """[H, W, 3] specular albedo."""
    roughness: NDArray[np.float32]
    """[H, W, 1] roughness; the GGX width is its square."""
    source: MapSource
    """Whose it is, by the title of a user's own; what is drawn is ours, by name of its family."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Finish:
    """Albedos and roughness of one thing that a surface is made of, everywhere or per texel."""

    diffuse_rgb: Numbers
    """[3] or [N, N, 3]."""
    specular_rgb: Numbers
    """[3] or [N, N, 3]."""
    roughness: Numbers
    """One roughness [] or one per texel [N, N]."""

    def toned(self, tone: ArrayLike) -> "Finish":
        """Return it with its diffuse albedo times a number in [0, 1], one or [N, N]."""
        factor = np.clip(np.asarray(tone, np.float64), 0, 1)
        return replace(self, diffuse_rgb=self.diffuse_rgb * factor[..., None])

    def dimmed(self, tone: ArrayLike) -> "Finish":
        """Return it with both albedos times a number in [0, 1], one or [N, N]."""
        factor = np.clip(np.asarray(tone, np.float64), 0, 1)
        return replace(self.toned(tone), specular_rgb=self.specular_rgb * factor[..., None])

    def rougher(self, by: ArrayLike) -> "Finish":
        """Return it with a number, one or [N, N], added to the roughness."""
        return replace(self, roughness=self.roughness + np.asarray(by, np.float64))

    def covered(self, other: "Finish", share: ArrayLike) -> "Finish":
        """Return it with `share` of its area, one or [N, N], covered by another one.

        Albedos are area means; of the roughness, it is the mean of the GGX widths that counts.
        """
        part = np.asarray(share, np.float64)
        base_roughness = np.clip(self.roughness, 0, 1)
        cover_roughness = np.clip(other.roughness, 0, 1)
        return Finish(
            diffuse_rgb=lerp(self.diffuse_rgb, other.diffuse_rgb, part[..., None]),
            specular_rgb=lerp(self.specular_rgb, other.specular_rgb, part[..., None]),
            roughness=np.sqrt(
                lerp(base_roughness * base_roughness, cover_roughness * cover_roughness, part)
            ),
        )


class GlossRanges(TypedDict):
    """Ranges that several finishes share."""

    specular: tuple[float, float]
    roughness: tuple[float, float]


LEAST_TINT = 0.88
"""A natural colour is one between two, each channel times a number from this to 1."""


class SurfaceDraws(RecordedSampler):
    """Draws by name, and finishes whose colours follow the surface's own choice."""

    def __init__(
        self, rng: np.random.Generator, *, natural_share: float, albedo: tuple[float, float]
    ) -> None:
        """Begin a surface.

        Args:
            rng: where the numbers come from.
            natural_share: probability of the family's natural colours, for all of its finishes.
            albedo: range of each channel otherwise.
        """
        super().__init__(rng)
        self._natural = self.holds("natural colours", natural_share)
        self._albedo = albedo

    def finish(
        self,
        name: str,
        *,
        low: RGB,
        high: RGB,
        specular: tuple[float, float] = (0.02, 0.1),
        roughness: tuple[float, float],
        metal: bool = False,
    ) -> Finish:
        """Return a finish of one base colour.

        Args:
            name: of the finish.
            low, high: ends between which natural base colours lie.
            specular: range of the share of light that the specular lobe reflects.
            roughness: range of that of the specular lobe.
            metal: whether the base colour is that of the specular lobe; otherwise it is grey.
        """
        least, most = self._albedo
        if self._natural:
            tint = self.colour(f"{name}: tint", (LEAST_TINT,) * 3, (1.0,) * 3)
            base = tint * self.shade(f"{name}: colour", low, high)
        else:
            base = self.colour(f"{name}: any colour", (least,) * 3, (most,) * 3)
        base = np.clip(base, 0, MOST_ALBEDO)
        share = min(self.uniform(f"{name}: specular share", *specular), MOST_ALBEDO)
        return Finish(
            diffuse_rgb=(1 - share) * base,
            specular_rgb=share * (base if metal else np.ones(3)),
            roughness=np.asarray(self.uniform(f"{name}: roughness", *roughness)),
        )
