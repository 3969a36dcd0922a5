"""Renders one view by Trilight's path tracer under any settings, with its cost.

CPU seconds are those of the process: sampling, guide pictures, measuring the stated error, and one
denoise. Loading the scene is not counted; kernels are warm.
"""

import dataclasses

from infra.render.methods import warm_up_denoiser
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.results import RenderedView
from pipeline.renders.settings import RenderSettings
from storage.metrics import MAX_DB
from storage.records.scene import Scene

SEED = 20_261_122
"""Seed of these pictures; no dataset preset and no run uses it."""

_SMALL = 32
"""Width in pixels of the picture that compiles the kernels."""


def fixed_samples(resolution: int, spp: int) -> RenderSettings:
    """Return settings of a fixed number of samples, which no stated error stops early.

    Args:
        resolution: width in pixels.
        spp: samples per pixel; a multiple of 128 for the best sampling.
    """
    return RenderSettings(
        resolution=resolution,
        noise_floor_db=MAX_DB - 1,
        min_spp=spp,
        max_spp=spp,
        min_mean_radiance=0.0,
    )


def shot(scene: Scene, settings: RenderSettings) -> RenderedView:
    """Return a scene's first view, always of one seed; runs in a render child."""
    small = dataclasses.replace(settings, resolution=_SMALL, max_spp=settings.min_spp)
    pose = scene.c2w[0]
    fov_deg = float(scene.fov_deg[0])
    SceneRenderer(scene, small).render_view(pose, fov_deg, seed=0)  # compiles
    if settings.denoiser != "off":
        warm_up_denoiser(settings.resolution, settings.denoiser)
    return SceneRenderer(scene, settings).render_view(pose, fov_deg, SEED)
