"""One scene four times: with means and lamps alone, with textures, below a sky, and with both.

Geometry, lamps and camera are the same; the mean of a texture stands where there is none. So what
maps cost, and what they do to the stated floor, is seen beside the same picture without them.
"""

import dataclasses
import functools
import time
from collections.abc import Mapping

import numpy as np

from infra.bench.sides.judged_pictures import Reference, figures, raw_reference, shrunk
from infra.bench.sides.shots import warm_up_denoiser, warm_up_kernels
from infra.bench.subjects.named_scenes import first_composed
from pipeline.builds.training import smoke
from pipeline.renders.camera import Camera
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.results import RenderedView
from pipeline.renders.settings import PASS_SPP, RenderSettings
from pipeline.renders.sky_share import sky_share
from scene_templates.skies.settings import SkySettings
from scene_templates.textures import TextureSettings
from storage.errors import Rejected
from storage.records.packed_maps import packed_maps
from storage.records.profiles import pack_arrays, pack_picture
from storage.records.retextured import without_maps
from storage.records.scene import Scene
from storage.records.scene_file import encode_arrays
from storage.seeds import seed_for

MAPS = {
    "plain": (False, False),
    "textured": (True, False),
    "sky": (False, True),
    "textured, sky seen": (True, True),
}
"""Whether a scene keeps its textures, and whether its sky; the last one is seen by the camera."""

_REFERENCE_PX = 128
"""Pixels across the references: every pixel of 64 has four of them."""

_SEED = 20_261_125
"""Seed of scenes and samples that are judged here; no build, no run and no other experiment uses
it."""

_ROUNDS = 3


def mapped_views(
    scene_index: int, settings: RenderSettings, spp: int
) -> dict[str, dict[str, float]]:
    """Return the figures of a scene's first view with each choice of maps; runs in a render child.

    Args:
        scene_index: of a sequence of its own.
        settings: of the pictures.
        spp: samples per pixel of the reference at 128 pixels, both halves together, a multiple of
            128.

    Raises:
        Rejected: the scene cannot be composed, or has no light in this view.
    """
    scenes = mapped_scenes(scene_index)
    passes = pass_core_s(scenes, settings)
    found = {}
    for number, (name, scene) in enumerate(scenes.items()):
        pose, fov_deg = np.asarray(scene.c2w[0], np.float64), float(scene.fov_deg[0])
        camera = Camera(c2w=pose, fov_deg=fov_deg, resolution=_REFERENCE_PX)
        reference = raw_reference(scene, camera, spp, scene_index, number)
        seed = seed_for(_SEED, "mapped", scene_index, number)
        view, core_s, load_core_s = _timed_view(scene, settings, seed)
        found[name] = {
            "core_s": core_s,
            "load_ms": 1000 * load_core_s,
            "pass_ms": 1000 * passes[name],
            "pass_ratio": passes[name] / passes["plain"],
            **_judged(view, reference, settings.resolution),
            **_stored_kb(scene, view),
            **_of_sky(scene),
        }
    return found


@functools.lru_cache(maxsize=1)
def mapped_scenes(scene_index: int) -> dict[str, Scene]:
    """Return a scene by what it keeps of its maps, as MAPS says, in that order."""
    settings = dataclasses.replace(
        smoke().scenes,
        num_views=1,
        textures=TextureSettings(share=1.0),
        skies=SkySettings(share=1.0, seen_share=1.0),
    )
    whole, _ = first_composed(settings, scene_index, seed=_SEED)
    if whole is None:
        raise Rejected("no_scene", f"scene {scene_index}: every attempt was rejected")
    found = {}
    for name, (textured, lit) in MAPS.items():
        scene = without_maps(whole, textures=not textured, environment=not lit)
        sky = scene.environment
        if sky is not None and not textured:
            scene = dataclasses.replace(scene, environment=dataclasses.replace(sky, is_seen=False))
        found[name] = scene
    return found


def pass_core_s(scenes: Mapping[str, Scene], settings: RenderSettings) -> dict[str, float]:
    """Return core-seconds of one pass of 64 samples of each scene: the least of three, in turns."""
    depths = {"max_depth": settings.max_depth, "rr_depth": settings.rr_depth}
    tracers = {name: load_tracer(scene, **depths) for name, scene in scenes.items()}
    spent: dict[str, list[float]] = {name: [] for name in scenes}
    for number in range(1 + _ROUNDS):
        for name, tracer in tracers.items():
            scene = scenes[name]
            camera = Camera(
                c2w=np.asarray(scene.c2w[0], np.float64),
                fov_deg=float(scene.fov_deg[0]),
                resolution=settings.resolution,
            )
            started = time.process_time()
            tracer.radiance(camera, seed=number, spp=PASS_SPP[0])
            spent[name].append(time.process_time() - started)
    return {name: min(each[1:]) for name, each in spent.items()}  # the first one compiles


def _timed_view(
    scene: Scene, settings: RenderSettings, seed: int
) -> tuple[RenderedView, float, float]:
    """Return a scene's first view, its core-seconds with loading the scene, and those of that."""
    warm_up_kernels(scene, settings)
    warm_up_denoiser(settings.resolution)
    started = time.process_time()
    renderer = SceneRenderer(scene, settings)
    loaded = time.process_time()
    view = renderer.render_view(scene.c2w[0], float(scene.fov_deg[0]), seed)
    return view, time.process_time() - started, loaded - started


def _judged(view: RenderedView, reference: Reference, resolution: int) -> dict[str, float]:
    return figures(view, shrunk(reference, resolution))


def _stored_kb(scene: Scene, view: RenderedView) -> dict[str, float]:
    """Return kilobytes in a shard of the profile `compact`."""
    arrays = pack_arrays(encode_arrays(scene), "compact")
    picture = pack_picture(view.radiance_rgb, view.noise_floor_db, "compact")
    return {
        "scene_kb": sum(map(len, arrays.values())) / 1000,
        "maps_kb": sum(map(len, packed_maps(scene).values())) / 1000,
        "picture_kb": len(picture) / 1000,
    }


def _of_sky(scene: Scene) -> dict[str, float]:
    sky = scene.environment
    if sky is None:
        return {"sky_share": 0.0, "sky_peak": 0.0}
    grey = sky.radiance_rgb.mean(axis=-1)
    peak = float(grey.max() / max(float(grey.mean()), 1e-12))
    return {"sky_share": sky_share(scene, sky), "sky_peak": peak}
