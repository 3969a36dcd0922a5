"""The same network with few lights at a time: do groups or one pass make the better picture?"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.light_groups import light_groups
from model.neural_renderer import NeuralRenderer
from model.renderformer import RenderFormer
from model.trained_range import MAX_LIGHTS
from storage.records.scene import Scene
from train.evaluation.groups import summary
from train.evaluation.judged_view import NETWORK, JudgedView

GROUPED = f"network, {MAX_LIGHTS} lights at a time"
"""Name of the contestant; only scenes with more lights, or lights inside objects, have it."""


def grouped_pictures(
    network: RenderFormer, scene: Scene, resolution: int
) -> NDArray[np.float64] | None:
    """Return what `trilight render` shows of a scene, its groups of lights added up.

    Returns:
        Linear radiance [V, R, R, 3] of at least 0, or None where one group holds every light, so
        that one pass is the same.
    """
    if len(light_groups(scene, MAX_LIGHTS)) == 1:
        return None
    renderer = NeuralRenderer(network)
    prepared = renderer.prepare(scene)
    pictures = [
        renderer.view(prepared, c2w, float(fov_deg), resolution)
        for c2w, fov_deg in zip(scene.c2w, scene.fov_deg, strict=True)
    ]
    return np.stack(pictures).astype(np.float64)


def passes_compared(views: Sequence[JudgedView]) -> dict[str, Any] | None:
    """Return the summaries of one pass and of groups over the views that have both, if any has."""
    both = [view for view in views if GROUPED in view.scores]
    if not both:
        return None
    return {"one pass": summary(both, NETWORK), "groups": summary(both, GROUPED)}
