"""`SurfaceDraws`: the draws of a surface, with colours either natural or anything."""

from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from scene_templates.recorded_sampler import RecordedSampler
from scene_templates.surfaces.maps import Finish, finish

RGB = tuple[float, float, float]
"""Linear, Rec.709 primaries."""


class GlossRanges(TypedDict):
    """Ranges that several finishes share."""

    specular: tuple[float, float]
    """Range of the specular albedo, from low to high."""
    roughness: tuple[float, float]
    """Range of the roughness, from low to high."""


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
        """Return a finish; natural base colours lie between `low` and `high`."""
        return finish(
            self._natural_colour(name, low, high) if self._natural else self._any_colour(name),
            specular_share=self.uniform(f"{name}: specular share", *specular),
            roughness=self.uniform(f"{name}: roughness", *roughness),
            metal=metal,
        )

    def _natural_colour(self, name: str, low: RGB, high: RGB) -> NDArray[np.float64]:
        tint = self.colour(f"{name}: tint", (LEAST_TINT,) * 3, (1.0,) * 3)
        return tint * self.shade(f"{name}: colour", low, high)

    def _any_colour(self, name: str) -> NDArray[np.float64]:
        least, most = self._albedo
        return self.colour(f"{name}: any colour", (least,) * 3, (most,) * 3)
