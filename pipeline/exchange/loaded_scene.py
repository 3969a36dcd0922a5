"""`LoadedScene`: what every reader of a scene format returns."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.records.scene import Scene

Pictures = NDArray[np.float32] | None
"""[V, R, R, 3] linear radiance of all views, or None."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LoadedScene:
    """A scene that was read, with notes on what it lacks."""

    scene: Scene
    """The scene, which passes `Scene.check`."""
    notes: tuple[str, ...]
    """Sentences about unknown fields of the file and what could not be read."""
    radiance_rgb: Pictures = None
    """Pictures of all views, where they were requested and the source has them."""
