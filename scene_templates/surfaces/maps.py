"""`SurfaceMaps`: what a textured surface is, and `Finish`, what its parts are mixed from."""

from dataclasses import dataclass, field, replace
from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scene_templates.exact import Numbers, lerp
from scene_templates.layout import RGB
from scene_templates.recorded_sampler import RecordedSampler
from storage.records.texture import MapSource

MOST_ALBEDO = 0.95
"""Greatest channel of a base colour and greatest specular share: no surface is whiter, and the sum
of both albedos stays below 1 by far more than float32 rounds."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceMaps:
    """A surface that repeats in both directions; linear colour, rows from the top.

    Row 0 is the top, where v = 1 (scene_templates.surfaces.texels). What is drawn is square.
    """

    family: str
    """Name of the family that it was drawn from, or title of a user's own."""
    diffuse_rgb: NDArray[np.float32]
    """[H, W, 3] diffuse albedo; with the specular one at most 1 in each channel."""
    specular_rgb: NDArray[np.float32]
    """[H, W, 3] specular albedo."""
    roughness: NDArray[np.float32]
    """[H, W, 1] roughness; the GGX width is its square."""
    source: MapSource = field(default_factory=MapSource)
    """Whose it is; what is drawn is ours."""


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
