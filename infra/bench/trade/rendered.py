"""What a render child does for the knobs: one view under many settings, each with its price."""

import time
from collections.abc import Mapping
from dataclasses import dataclass

from infra.bench.renders.ladder import RememberingRenderer, warm_up_denoiser, warm_up_kernels
from pipeline.renders.renderer import RenderedView, SceneRenderer
from pipeline.renders.settings import RenderSettings
from storage.lights import encode_lights_exr
from storage.profiles import pack_picture
from storage.scene import Scene

SEED = 20_261_122
"""Of pictures and of scenes that are drawn here: no build and no run has it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """One view under one setting."""

    view: RenderedView
    """The picture with its floor and its samples."""
    core_s: float
    """What it takes alone: samples, guide pictures, measuring the floor, the last denoise."""
    packed_bytes: int
    """In the profile `compact`, with the pictures of single lights where there are any."""


def shots(scene: Scene, variants: Mapping[str, RenderSettings]) -> dict[str, Shot]:
    """Return a scene's first view under each setting, with equal seeds; runs in a render child.

    Settings of equal depths and resolution share what is traced, and each is charged for it.
    """
    renderers: dict[tuple[int, ...], RememberingRenderer] = {}
    found = {}
    for name, settings in variants.items():
        key = (settings.max_depth, settings.rr_depth, settings.resolution)
        if settings.per_light:
            warm_up_kernels(scene, settings)
            found[name] = _alone(scene, settings)
            continue
        if key not in renderers:
            warm_up_kernels(scene, settings)
            renderers[key] = RememberingRenderer(scene, settings)
        if settings.denoiser != "off":
            warm_up_denoiser(settings.resolution, settings.denoiser)
        view, core_s = renderers[key].timed_view(SEED, settings)
        found[name] = _shot(view, core_s)
    return found


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
