"""`ProgressiveRenderer`: a picture that appears at once and then improves step by step.

First come previews of few samples, whose error is unknown; then the picture of `SceneRenderer`
grows to its target, shown at each measurement. What comes at the end is, bit by bit, what
`SceneRenderer` alone makes.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from pipeline.renders.camera import PixelCamera
from pipeline.renders.preview import preview_steps, usual_filter
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.results import GrowingPicture, RenderedView, run_to_end
from pipeline.renders.settings import RenderSettings
from storage.records.scene import Scene
from storage.renderer import Sampling

FIRST_LOOKS_SPP = (1, 4, 16)
"""Samples of the previews; each is a picture of its own, and together they cost less than a third
of the samples before the first measurement."""


class ProgressiveRenderer:
    """A scene loaded once, for pictures that grow."""

    def __init__(self, scene: Scene, settings: RenderSettings) -> None:
        """Load a scene; raises as `SceneRenderer`, which `settings` are for."""
        self._settings = settings
        self._measured = SceneRenderer(scene, settings, shows_looks=True)

    def view_steps(
        self, c2w: ArrayLike, fov_deg: float, seed: int
    ) -> Iterator[Sampling | RenderedView]:
        """Yield looks, the progress of sampling between them, and last the finished picture.

        Args:
            c2w: [4, 4] camera to world.
            fov_deg: full field of view in degrees.
            seed: of the samples.

        Raises:
            Rejected: as of `SceneRenderer.render_view`.
        """
        pose = np.asarray(c2w, np.float64)
        camera = PixelCamera(c2w=pose, fov_deg=fov_deg, resolution=self._settings.resolution)
        for spp in FIRST_LOOKS_SPP:
            steps = preview_steps(self._measured.tracer, camera, seed, spp, usual_filter(spp))
            preview = run_to_end(steps)
            yield GrowingPicture(
                spp=preview.spp,
                expected_spp=self._settings.first_spp,
                missing_db=None,
                radiance_rgb=preview.radiance_rgb,
                floor=None,
                core_s=preview.core_s,
            )
        yield from self._measured.view_steps(c2w, fov_deg, seed)
