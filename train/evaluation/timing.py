"""What the first and a further view of a scene take a renderer, in CPU seconds."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.records.scene import Scene
from storage.renderer import Camera, ReadyScene, Renderer


@dataclass(frozen=True, kw_only=True)
class Price:
    """CPU seconds of a renderer."""

    first_s: float
    """CPU seconds of the first view of a scene, loading included."""
    further_s: float
    """CPU seconds of a further view."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TimedScene:
    """Scene that a renderer has loaded, with what that and its pictures take."""

    loaded: ReadyScene
    radiance_rgb: NDArray[np.float32]
    """[R, R, 3] linear radiance of the first view."""
    price: Price
    """Medians over the measured rounds."""


def time_scene(renderer: Renderer, scene: Scene, name: str, rounds: int = 1) -> TimedScene:
    """Load a scene and render its first view twice, in rounds after one that warms everything up.

    Args:
        renderer: a renderer that states its CPU seconds.
        name: name of the scene in messages.

    Raises:
        Unrenderable, TrilightError: as `Renderer.load` and `ReadyScene.render`.
    """
    camera = Camera.of_scene(scene, 0)
    prices = []
    for _ in range(1 + rounds):
        loaded = renderer.load(scene, name)
        first = loaded.render(camera)
        further = loaded.render(camera)
        first_s = (loaded.cpu_seconds or 0.0) + (first.cpu_seconds or 0.0)
        prices.append(Price(first_s=first_s, further_s=further.cpu_seconds or 0.0))
    return TimedScene(
        loaded=loaded, radiance_rgb=further.radiance_rgb, price=median_price(prices[1:])
    )


def median_price(prices: Sequence[Price]) -> Price:
    """Return the medians of prices."""
    return Price(
        first_s=float(np.median([price.first_s for price in prices])),
        further_s=float(np.median([price.further_s for price in prices])),
    )
