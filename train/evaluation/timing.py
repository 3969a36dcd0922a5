"""What the first and a further view of a scene take a renderer, in CPU seconds."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from storage.records.scene import Scene
from storage.renderer import Camera, LoadedScene, Renderer


@dataclass(frozen=True, kw_only=True)
class Price:
    """CPU seconds of a renderer."""

    first_s: float
    """CPU seconds of the first view of a scene, loading included."""
    further_s: float
    """CPU seconds of a further view."""


def time_scene(renderer: Renderer, scene: Scene, name: str) -> tuple[LoadedScene, Price]:
    """Load a scene and render its first view twice, after a round that warms everything up.

    Args:
        renderer: a renderer that states its CPU seconds.
        scene: the scene.
        name: name of the scene in messages.

    Raises:
        Unrenderable, TrilightError: as `Renderer.load` and `LoadedScene.render`.
    """
    for _ in range(2):
        loaded = renderer.load(scene, name)
        camera = Camera.of_scene(scene, 0)
        first_s, further_s = (loaded.render(camera).cpu_seconds or 0.0 for _ in range(2))
    return loaded, Price(first_s=(loaded.cpu_seconds or 0.0) + first_s, further_s=further_s)


def median_price(prices: Sequence[Price]) -> Price:
    """Return the medians of prices."""
    return Price(
        first_s=float(np.median([price.first_s for price in prices])),
        further_s=float(np.median([price.further_s for price in prices])),
    )
