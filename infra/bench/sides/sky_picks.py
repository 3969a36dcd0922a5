"""One scene below several skies, whose maps are picked in other shares than the product picks them.

Errors are those of raw pictures, before any denoiser, held against raw references in two halves.
"""

import dataclasses
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from infra.bench.sides.judged_pictures import raw_reference, true_error_db
from infra.bench.sides.sampled_pictures import first_camera
from infra.bench.subjects.named_scenes import sampled_scene
from pipeline.renders.settings import RenderSettings
from pipeline.renders.sky_share import lamp_power, row_solid_angles, sky_share, surface_radius
from pipeline.renders.sky_table import SkyTable
from pipeline.renders.vector_tracer import VectorTracer
from scene_templates.skies.drawn_scene import lamp_irradiance
from storage.conventions import log10_radiance
from storage.records.environment import Environment
from storage.records.material import EMISSION
from storage.records.scene import Scene
from storage.seeds import seed_for

_HEIGHT = 128
_PX = 48
_SPP = 16
_PICTURES = 8
_SEED = 20_261_126
_BRIGHT, _DIM = 5.0, 0.05


def _even(up: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.ones_like(up)


def _smooth(up: NDArray[np.float64]) -> NDArray[np.float64]:
    return 1.2 + up


def _sun(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a sky of 1 and a sun in one texel, a third down, that has four times its light."""
    texels = np.ones_like(up)
    row = len(up) // 3
    texels[row, len(up) // 5] += 4 * 4 * np.pi / row_solid_angles(len(up))[row]
    return texels


SKIES: dict[str, tuple[Callable[[NDArray[np.float64]], NDArray[np.float64]], float]] = {
    "constant, 5 times the lamps": (_even, _BRIGHT),
    "constant, a twentieth of them": (_even, _DIM),
    "smooth, as bright as they are": (_smooth, 1.0),
    "a sun of one texel": (_sun, 1.0),
}
"""The form of each map by its height above the horizon, and its irradiance over the lamps'."""


def picked_pictures(name: str, spp: int) -> dict[str, dict[str, float]]:
    """Return the figures of one sky for each way of picking it; runs in a render child.

    Args:
        name: of SKIES.
        spp: samples per pixel of the reference, both halves together, a multiple of 128.
    """
    scene = _below(name)
    sky = scene.environment
    assert sky is not None
    camera = first_camera(scene, _PX)
    reference = raw_reference(scene, camera, spp, 1)
    depths = {"max_depth": RenderSettings.max_depth, "rr_depth": RenderSettings.rr_depth}
    everywhere, found = np.ones((_PX, _PX), bool), dict[str, dict[str, float]]()
    for way, share in _shares(scene, sky).items():
        tracer = VectorTracer(scene, **depths)
        tracer._scene.sky = SkyTable(sky, share)
        tracer.radiance(camera, seed=0, spp=_SPP)  # compiles
        started, errors = time.process_time(), []
        for number in range(_PICTURES):
            seed = seed_for(_SEED, "picked", number)
            picture = tracer.radiance(camera, seed=seed, spp=_SPP)
            error_db, _ = true_error_db(picture, reference, log10_radiance, everywhere)
            errors.append(10 ** (-error_db / 10))
        core_s = (time.process_time() - started) / _PICTURES
        error = float(np.mean(errors))
        found[way] = {"core_s": core_s, "share": share, "error_e5": 1e5 * error}
    least = min(each["error_e5"] for each in found.values())
    return {way: {**each, "over_least": each["error_e5"] / least} for way, each in found.items()}


WAYS = ("as the average lamp", "by its peaks (ours)", "by its whole power")


def _shares(scene: Scene, sky: Environment) -> dict[str, float]:
    lamps = len(np.unique(scene.object_index[scene.triangle_emits]))
    grey = sky.radiance_rgb.mean(axis=-1, dtype=np.float64)
    mean = float((grey * row_solid_angles(len(grey))[:, None]).sum() / (4 * np.pi))
    whole = 2 * np.pi * surface_radius(scene) ** 2 * mean
    shares = (1 / (lamps + 1), sky_share(scene, sky), whole / (whole + lamp_power(scene)))
    return dict(zip(WAYS, shares, strict=True))


def _below(name: str) -> Scene:
    """Return a sampled scene below a sky whose mean has the stated irradiance over its lamps'."""
    form, over_lamps = SKIES[name]
    scene = sampled_scene(0)
    emits = scene.triangle_emits
    corners = scene.vertex_positions[scene.faces[emits]].astype(np.float64)
    radiance = scene.materials[scene.material_index[emits], EMISSION].astype(np.float64)
    up = np.cos(np.pi * (np.arange(_HEIGHT) + 0.5) / _HEIGHT)[:, None]
    grey = form(np.repeat(up, 2 * _HEIGHT, axis=1))
    mean = (grey * row_solid_angles(_HEIGHT)[:, None]).sum() / (4 * np.pi)
    grey *= over_lamps * lamp_irradiance(corners, radiance) / np.pi / mean
    texels = np.repeat(grey[..., None], 3, axis=-1).astype(np.float32)
    sky = Environment(radiance_rgb=texels)
    sky.check()
    return dataclasses.replace(scene, environment=sky)
