"""Previews of one view with more and more samples, where no pass of samples is traced twice."""

import copy
import time
from collections.abc import Sequence

import numpy as np

from infra.bench.sides.judged_pictures import Reference, raw_reference
from infra.bench.sides.shots import SEED, RememberingTracer, warm_up_denoiser
from infra.timed_views import TimedViews
from pipeline.renders.camera import Camera
from pipeline.renders.preview import PreviewRenderer, PreviewSettings
from pipeline.renders.renderer import finished
from pipeline.renders.settings import Filtered
from storage.records.scene import Scene

_SMALL = 32


class RememberingPreviews(PreviewRenderer):
    """The product's renderer of previews around a tracer that remembers the passes of a view."""

    def __init__(self, scene: Scene, settings: PreviewSettings) -> None:
        super().__init__(scene, settings)
        self._camera = (np.asarray(scene.c2w[0], np.float64), float(scene.fov_deg[0]))
        self._remembering = RememberingTracer(self._tracer)
        self._tracer = self._remembering

    def timed(self, settings: PreviewSettings, scene_s: float) -> TimedViews:
        """Return the first view under other settings, with the core-seconds it would take alone."""
        other = copy.copy(self)
        other._settings = settings
        self._remembering.ledger.begin_view()
        began = time.process_time()
        preview = finished(other.view_steps(*self._camera, SEED))
        view_s = time.process_time() - began + self._remembering.ledger.owed_core_s
        return TimedViews(
            radiance_rgb=preview.radiance_rgb, first_s=scene_s + view_s, further_s=view_s
        )


def preview_ladder(
    scene: Scene, resolution: int, wanted: Sequence[tuple[int, Filtered]], reference_spp: int
) -> tuple[list[TimedViews], Reference]:
    """Return previews of the first view by samples and filter, and raw halves of it.

    Runs in a render child.
    """
    warm_up_denoiser(resolution, "fast")
    warm_up_denoiser(resolution, "high")
    settings = [
        PreviewSettings(resolution=resolution, spp=spp, denoiser=denoiser)
        for spp, denoiser in wanted
    ]
    for spp in (1, 4, 16, 64):  # kernels are compiled, or read from disk
        small = PreviewSettings(resolution=_SMALL, spp=spp)
        pose, fov_deg = np.asarray(scene.c2w[0], np.float64), float(scene.fov_deg[0])
        finished(PreviewRenderer(scene, small).view_steps(pose, fov_deg, SEED))
    began = time.process_time()
    renderer = RememberingPreviews(scene, settings[0])
    scene_s = time.process_time() - began
    found = [renderer.timed(one, scene_s) for one in settings]
    camera = Camera(c2w=pose, fov_deg=fov_deg, resolution=resolution)
    return found, raw_reference(scene, camera, reference_spp)
