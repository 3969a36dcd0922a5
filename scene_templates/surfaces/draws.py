"""`SurfaceDraws`: the draws of a surface, with colours either natural or anything."""

import numpy as np

from scene_templates.stated_draws import StatedDraws
from scene_templates.surfaces.maps import Finish, finish

RGB = tuple[float, float, float]
"""Linear, Rec.709 primaries."""


class SurfaceDraws(StatedDraws):
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
        """Return a finish; `low` and `high` are its natural base colours."""
        least, most = self._albedo
        ends = (low, high) if self._natural else ((least,) * 3, (most,) * 3)
        return finish(
            self.colour(f"{name}: base colour", *ends),
            specular_share=self.uniform(f"{name}: specular share", *specular),
            roughness=self.uniform(f"{name}: roughness", *roughness),
            metal=metal,
        )
