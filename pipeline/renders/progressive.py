"""`ProgressiveRenderer`: a picture that appears at once and then improves step by step.

First come previews of few samples, whose error is unknown; then the picture of `SceneRenderer`
grows to its target, shown at each measurement. What comes at the end is, bit by bit, what
`SceneRenderer` alone makes.
"""

import time
from collections.abc import Generator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.renders.camera import Camera
from pipeline.renders.noise_floor import MeasuredFloor
from pipeline.renders.preview import denoise_preview, samples_sum, usual_filter
from pipeline.renders.renderer import SceneRenderer, representable, run_to_end
from pipeline.renders.results import GrowingPicture, RenderedView
from pipeline.renders.settings import RenderSettings
from pipeline.renders.view_pictures import require_bounded
from storage.errors import Rejected
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
    ) -> Generator[Sampling, None, GrowingPicture]:
        """Yield looks, and the progress of sampling between them; return the last look.

        Args:
            c2w: [4, 4] camera to world.
            fov_deg: full field of view in degrees.
            seed: of the samples.

        Raises:
            Rejected: as of `SceneRenderer.render_view`.
        """
        pose = np.asarray(c2w, np.float64)
        camera = Camera(c2w=pose, fov_deg=fov_deg, resolution=self._settings.resolution)
        for spp in FIRST_LOOKS_SPP:
            yield run_to_end(self._preview(camera, seed, spp))
        view: RenderedView = yield from self._measured.view_steps(c2w, fov_deg, seed)
        floor = MeasuredFloor(
            log_db=view.noise_floor_db,
            linear_db=view.noise_floor_linear_db,
            object_log_db=view.object_noise_floor_db,
        )
        return GrowingPicture(
            spp=view.spp,
            expected_spp=view.spp,
            missing_db=None,
            radiance_rgb=view.radiance_rgb,
            floor=floor,
            core_s=self._measured.used_core_s,
        )

    def preview_steps(
        self, c2w: ArrayLike, fov_deg: float, seed: int, spp: int
    ) -> Generator[Sampling, None, GrowingPicture]:
        """Return a picture of so many samples, with one denoise, yielding after each pass.

        It is the one that `PreviewRenderer` makes, whose arguments and errors these are.
        """
        pose = np.asarray(c2w, np.float64)
        camera = Camera(c2w=pose, fov_deg=fov_deg, resolution=self._settings.resolution)
        return (yield from self._preview(camera, seed, spp))

    def _preview(
        self, camera: Camera, seed: int, spp: int
    ) -> Generator[Sampling, None, GrowingPicture]:
        tracer = self._measured.tracer
        began_s = time.process_time()
        total = np.zeros(3)
        done = 0
        while done < spp:
            part, done = samples_sum(tracer, camera, seed, done, spp)
            total = total + part
            yield Sampling(spp=done, expected_spp=spp, missing_db=None)
        mean: NDArray[np.float32] = (total / done).astype(np.float32)
        if not np.isfinite(mean).all():
            raise Rejected("nonfinite_radiance", "raw samples are not finite")
        require_bounded(float(mean.max()))
        picture = representable(denoise_preview(tracer, camera, mean, done, usual_filter(done)))
        return GrowingPicture(
            spp=done,
            expected_spp=self._settings.first_spp,
            missing_db=None,
            radiance_rgb=picture,
            floor=None,
            core_s=time.process_time() - began_s,
        )
