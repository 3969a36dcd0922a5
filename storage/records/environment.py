"""`Environment`: an environment map (HDRI), light from far away from all directions.

Its map is latitude-longitude, linear radiance, with the axes of storage.conventions. A scene may
turn it. A map that is absent costs nothing, and is another thing than a black one that is seen.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from storage.records.scene_laws import broken_law, require_array, require_law, require_rotations
from storage.records.texture import MAX_SIDE, MapSource, content_digest

MAX_RADIANCE = 1e9
"""Greatest radiance of a map. A sun of 1e6 is usual; sums over the largest map stay finite."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Environment:
    """A latitude-longitude map of radiance from infinitely far away."""

    radiance_rgb: NDArray[np.float32]
    """[H, 2H, 3] linear radiance; row 0 is the top (+Z of the map)."""
    rotation: NDArray[np.float32] = field(default_factory=lambda: np.eye(3, dtype=np.float32))
    """[3, 3] from the axes of the map to those of the world."""
    is_seen: bool = False
    """True: cameras see the map. It lights the scene in any case."""
    source: MapSource = field(default_factory=MapSource)

    @cached_property
    def sha256(self) -> str:
        """Digest of the map alone: the same map, turned, is the same content."""
        return content_digest("environment", self.radiance_rgb)

    def to_map(self, directions: ArrayLike) -> NDArray[np.float64]:
        """Return directions [..., 3] of the world in the axes of the map."""
        return np.positive(directions, dtype=np.float64) @ self.rotation

    def check(self, called: str = "environment") -> None:
        """Raise TrilightError at the first broken law; `called` stands for the map."""
        radiance = self.radiance_rgb
        name = f"{called}.radiance_rgb"
        require_array(radiance, name, np.float32, (None, None, 3))
        if radiance.shape[1] != 2 * radiance.shape[0]:
            broken_law(f"{name} has shape {radiance.shape}", "(height, twice the height, 3)")
        if not 1 <= radiance.shape[0] <= MAX_SIDE // 2:
            broken_law(f"{name} has shape {radiance.shape}", f"sides of 1 to {MAX_SIDE} texels")
        if not (radiance.min() >= 0 and radiance.max() <= MAX_RADIANCE):  # or NaN
            lawful = (radiance >= 0) & (radiance <= MAX_RADIANCE)
            require_law(lawful, name, radiance, f"finite values from 0 to {MAX_RADIANCE:g}")
        rotation = self.rotation
        require_array(rotation, "environment.rotation", np.float32, (3, 3))
        require_rotations(rotation.T[None], "environment.rotation", rotation[None])


def row_solid_angles(height: int) -> NDArray[np.float64]:
    """Return the steradians [H] of a texel in each row of a map with 2 H columns."""
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    return (edges[:-1] - edges[1:]) * np.pi / height


def texel_means(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean over each texel [H, W] of what interpolation between their centres gives."""
    wide = np.pad(values, ((1, 1), (0, 0)), mode="edge")
    tall = (wide[:-2] + 6 * wide[1:-1] + wide[2:]) / 8
    round_about = np.pad(tall, ((0, 0), (1, 1)), mode="wrap")
    return (round_about[:, :-2] + 6 * round_about[:, 1:-1] + round_about[:, 2:]) / 8
