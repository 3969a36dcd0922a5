"""Pictures of one view by Trilight's path tracer and by plain Mitsuba, with their cost.

CPU seconds of ours are those of sampling, guide pictures, measuring the stated error, and one
denoise. Loading the scene is not counted; kernels are warm.

The other setup is that of a user of plain Mitsuba: the stock `path` integrator with its defaults,
one of its samplers, and Open Image Denoise once or not at all. Material and emitters are those of
tests/oracle/plugin_scene.py, which only a checkout has: without its one texture rough metals would
lose light, and no number of samples would give the right picture. Emitters are sampled by their
power, which is not Mitsuba's default, and the denoiser reads Trilight's guide pictures: both favor
plain Mitsuba.

References (infra.render.raw_references) cost a hundred times the pictures that they judge, and are
cached. The cache holds float32 numbers, and a new reference is rounded to them, too, so that a
figure does not depend on whether its reference was cached.
"""

import dataclasses
import time
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load, save

from infra.render.methods import SAMPLE_SEED, warm_up_denoiser
from infra.render.raw_references import (
    RawReference,
    first_camera,
    raw_reference,
    true_error_db,
)
from pipeline.isolation import IsolatedChild
from pipeline.renders.calibrated_error import LEAST_ERROR
from pipeline.renders.noise_floor import Curve, clamped_radiance, secant_slope
from pipeline.renders.renderer import RenderedView, SceneRenderer
from pipeline.renders.settings import RenderSettings
from pipeline.renders.tracer import PixelCamera, load_tracer
from storage.atomic import write_atomically
from storage.cache import cache_folder
from storage.conventions import log10_radiance
from storage.denoiser import Features, denoise
from storage.digests import canonical_json, sha256_hex
from storage.metrics import MAX_DB
from storage.records.scene import Scene
from storage.records.scene_file import scene_digest
from storage.renderer import Image
from storage.seeds import seed_for

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


def render_shot(scene: Scene, settings: RenderSettings) -> RenderedView:
    """Return a scene's first view, always of one seed; runs in a render child."""
    return render_shots(scene, settings, 1)[0][0]


def render_shots(
    scene: Scene, settings: RenderSettings, count: int
) -> tuple[list[RenderedView], float]:
    """Return the first `count` views of a scene, always of one seed; runs in a render child.

    The CPU seconds of all of them come second, with loading the scene and every look.
    """
    small = dataclasses.replace(settings, resolution=_SMALL, max_spp=settings.min_spp)
    poses = [(scene.c2w[view], float(scene.fov_deg[view])) for view in range(count)]
    SceneRenderer(scene, small).render_view(*poses[0], seed=0)  # compiles
    if settings.denoiser != "off":
        warm_up_denoiser(settings.resolution, settings.denoiser)
    started = time.process_time()
    renderer = SceneRenderer(scene, settings)
    views = [renderer.render_view(*pose, SAMPLE_SEED) for pose in poses]
    return views, time.process_time() - started


_RR_DEPTH = 5
"""Default of Mitsuba."""


_PASS_SPP = 256
"""Samples of a pixel that Mitsuba holds in memory at once; a picture is stratified over all."""


def render_levels(
    scene: Scene, resolution: int, levels_spp: tuple[int, ...], seed: int, sampler: str
) -> list[tuple[Image, Image]]:
    """Render a scene's first view with each number of samples; return it raw and denoised.

    CPU seconds are those of the samples; of the guide pictures and one denoise where denoised.

    Args:
        resolution: width in pixels.
        levels_spp: samples per pixel, at most 256 or multiples of it. Each picture has its own:
            several with fewer samples would be stratified less finely.
        sampler: plugin of Mitsuba.
    """
    camera = first_camera(scene, resolution)
    _plain_tracer(scene, sampler)(camera, seed_for(seed, "plain warm-up"), levels_spp[0])
    warm_up_denoiser(resolution)
    radiance = _plain_tracer(scene, sampler)
    features, features_core_s = _features(scene, camera)
    levels = []
    for spp in levels_spp:
        started = time.process_time()
        raw = radiance(camera, seed_for(seed, "plain", spp), spp)
        sampled_core_s = time.process_time() - started
        picture = denoise(raw, features, "high")
        core_s = features_core_s + time.process_time() - started
        levels.append(
            (
                Image(radiance_rgb=raw, samples=spp, cpu_seconds=sampled_core_s),
                Image(radiance_rgb=picture, samples=spp, cpu_seconds=core_s),
            )
        )
    return levels


def _features(scene: Scene, camera: PixelCamera) -> tuple[Features, float]:
    tracer = load_tracer(scene, max_depth=RenderSettings.max_depth, rr_depth=_RR_DEPTH)
    aux_spp = RenderSettings.aux_spp
    tracer.features(camera, spp=aux_spp)  # compiles
    started = time.process_time()
    features = tracer.features(camera, spp=aux_spp)
    return features, time.process_time() - started


def _plain_tracer(
    scene: Scene, sampler: str
) -> Callable[[PixelCamera, int, int], NDArray[np.float32]]:
    """Return a function of camera, seed and samples: their mean by Mitsuba, [R, R, 3]."""
    import mitsuba  # not before `activate`, which says where compiled kernels are kept

    from tests.oracle.plugin_scene import plugin_scene  # a checkout has it, as this package
    from tests.oracle.plugin_tracer import stock_sensor

    loaded = plugin_scene(scene)
    path = mitsuba.load_dict(
        {
            "type": "path",
            "max_depth": RenderSettings.max_depth,
            "rr_depth": _RR_DEPTH,
            "hide_emitters": True,
            "samples_per_pass": _PASS_SPP,
        }
    )

    def radiance(camera: PixelCamera, seed: int, spp: int) -> NDArray[np.float32]:
        picture = mitsuba.render(
            loaded,
            sensor=stock_sensor(camera, {"type": sampler, "sample_count": spp}),
            integrator=path,
            seed=mitsuba.UInt32(seed),
            spp=spp,
        )
        return np.array(picture, np.float32)

    return radiance


CURVES: Mapping[str, Curve] = {
    "log": log10_radiance, "linear": clamped_radiance, "object": log10_radiance
}  # fmt: skip
"""Tone curve of each metric of stated errors, by its name."""


def load_or_render_reference(
    child: IsolatedChild, scene: Scene, resolution: int, spp: int
) -> RawReference:
    """Return two halves of raw samples of a scene's first view, from the cache or by a child.

    Args:
        resolution: width in pixels.
        spp: samples per pixel of both halves together, a multiple of 128.
    """
    camera = first_camera(scene, resolution)
    view = [camera.c2w.tolist(), camera.fov_deg, resolution, spp]
    name = sha256_hex(canonical_json([scene_digest(scene), *view]))
    path = cache_folder("raw-references") / f"{name}.safetensors"
    if not path.is_file():
        made = child.call(raw_reference, scene, camera, spp)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, save(dict(zip("ab", made.astype(np.float32), strict=True))))
    stored = load(path.read_bytes())
    return np.stack([stored["a"], stored["b"]]).astype(np.float64)


def figures(view: RenderedView, reference: RawReference) -> dict[str, float]:
    """Return stated and true errors of a picture in dB, with the reference's uncertainty."""
    stated_db = {
        "log": view.noise_floor_db,
        "linear": view.noise_floor_linear_db,
        "object": view.object_noise_floor_db,
    }
    values = {
        "spp": float(view.spp),
        "at_cap": float(view.at_cap),
    }
    for name, curve in CURVES.items():
        pixels = view.hits if name == "object" else None
        true_db, open_db = true_error_db(view.radiance_rgb, reference, curve, pixels)
        excess_db = stated_db[name] - true_db
        values |= {
            f"{name}_stated_db": stated_db[name],
            f"{name}_true_db": true_db,
            f"{name}_open_db": open_db,
            f"{name}_caution_db": -excess_db,
            f"{name}_over_1": float(excess_db > 1),
            f"{name}_over_3": float(excess_db > 3),
        }
    return values


def difference_db(ours: RawReference, theirs: RawReference, curve: Curve) -> float:
    """Return the difference of two renderers in dB, without the noise of both.

    The squared difference is the mean of (A - C) (B - D), with halves A and B of one and C and D of
    the other. It may be below 0 by chance, which counts as no difference.
    """
    weight = np.square(secant_slope(curve, ours.mean(axis=0), theirs.mean(axis=0)))
    product = (ours - theirs).prod(axis=0)
    return float(-10 * np.log10(max((weight * product).mean(), LEAST_ERROR)))


def shrink_reference(reference: RawReference, resolution: int) -> RawReference:
    """Return a reference of a smaller width, which divides the reference's."""
    size = reference.shape[1] // resolution
    smaller: RawReference = reference.reshape(2, resolution, size, resolution, size, 3).mean((2, 4))
    return smaller
