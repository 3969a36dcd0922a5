"""What a render child does for the knobs: one view under many settings, each with its price."""

import dataclasses
import time
from collections.abc import Mapping
from dataclasses import dataclass

from infra.bench.renders.ladder import RememberingRenderer, warm_up_denoiser
from pipeline.renders.renderer import RenderedView, SceneRenderer
from pipeline.renders.settings import RenderSettings
from storage.lights import encode_lights_exr
from storage.profiles import pack_picture
from storage.scene import Scene

SEED = 20_261_122
_SMALL = 32
"""Pixels each way of what only compiles."""
_NEVER_DB = 99.0
"""A floor that no picture reaches, so that every one takes the samples that are asked for."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """One view under one setting."""

    view: RenderedView
    """The picture with its floor and its samples."""
    core_s: float
    """What it takes alone: samples, guide pictures, measuring the floor, the last denoise."""
    packed_bytes: int
    """In the profile `compact`, with the pictures of single lights where there are any."""


def fixed(resolution: int, spp: int) -> RenderSettings:
    """Return the settings of a picture with a fixed number of samples."""
    return RenderSettings(
        resolution=resolution,
        noise_floor_db=_NEVER_DB,
        min_spp=spp,
        max_spp=spp,
        min_mean_radiance=0.0,
    )


def shots(scene: Scene, variants: Mapping[str, RenderSettings]) -> dict[str, Shot]:
    """Return a scene's first view under each setting, with equal seeds; runs in a render child.

    Settings of equal depths and resolution share what is traced, and each is charged for it.
    """
    renderers: dict[tuple[int, ...], RememberingRenderer] = {}
    found = {}
    for name, settings in variants.items():
        key = (settings.max_depth, settings.rr_depth, settings.resolution)
        if settings.per_light:
            _warm_up(scene, settings)
            found[name] = _alone(scene, settings)
            continue
        if key not in renderers:
            _warm_up(scene, settings)
            renderers[key] = RememberingRenderer(scene, settings)
        if settings.denoiser != "off":
            warm_up_denoiser(settings.resolution, settings.denoiser)
        view, core_s = renderers[key].timed_view(SEED, settings)
        found[name] = _shot(view, core_s)
    return found


def _warm_up(scene: Scene, settings: RenderSettings) -> None:
    """Compile: kernels depend on the depth, not on the resolution."""
    small = dataclasses.replace(settings, resolution=_SMALL, max_spp=settings.min_spp)
    SceneRenderer(scene, small).render_view(scene.c2w[0], float(scene.fov_deg[0]), SEED)


def _alone(scene: Scene, settings: RenderSettings) -> Shot:
    renderer = SceneRenderer(scene, settings)
    started = time.process_time()
    view = renderer.render_view(scene.c2w[0], float(scene.fov_deg[0]), SEED)
    return _shot(view, time.process_time() - started)


def _shot(view: RenderedView, core_s: float) -> Shot:
    if view.lights_rgb is None:
        packed = len(pack_picture(view.radiance_rgb, view.noise_floor_db, "compact"))
    else:  # as storage.sample packs them: pictures stay the exact sum of their lights
        packed = len(pack_picture(view.radiance_rgb, view.noise_floor_db, "lossless"))
        packed += len(encode_lights_exr(view.lights_rgb))
    return Shot(view=view, core_s=core_s, packed_bytes=packed)
