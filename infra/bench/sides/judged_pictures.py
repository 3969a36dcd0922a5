"""Pictures with their stated floors, held against raw references that no denoiser has seen.

A reference is two halves of raw samples, rendered once at the largest width; a smaller picture's is
its means of blocks of pixels, with as many more samples. The squared error of a picture P is the
mean of (P - A) (P - B), in which the noise of the two halves A and B cancels on average: neither
needs to be converged. In a curve of radiance it is taken times the slope of the curve's secant
between the picture and the mean of both halves, as pipeline.renders.noise_floor does.
"""

import dataclasses
import functools
import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from infra.bench.sides.shots import warm_up_denoiser, warm_up_kernels
from infra.bench.subjects.named_scenes import first_composed
from pipeline.builds.training import smoke
from pipeline.renders.camera import Camera
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.noise_floor import Curve, clamped_radiance, secant_slope
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.results import RenderedView
from pipeline.renders.settings import PASS_SPP, RenderSettings
from storage.conventions import log10_radiance
from storage.errors import Rejected
from storage.records.scene import Scene
from storage.seeds import seed_for

REFERENCE_PX = 256
"""Pixels across the references, the largest width that is judged."""

VIEWS = 2
"""Cameras of a scene that are judged."""

_CURVES = {"log": log10_radiance, "linear": clamped_radiance, "object": log10_radiance}

_SEED = 20_261_124
"""Seed of scenes and samples that are judged here; no build and no run uses it."""


LEAST_ERROR = 1e-10
"""Squared errors below this, or below 0 by chance, count as this: 100 dB."""


@dataclass(frozen=True, kw_only=True)
class Judged:
    """A view of a scene, and how often it was drawn."""

    scene_index: int
    """Number of the scene, of a sequence of its own."""
    view: int
    """Number of the camera."""
    sample_seed: int
    """Number of the samples: the same view with others."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference:
    """Two halves of raw samples that share nothing."""

    a_rgb: NDArray[np.float64]
    """[R, R, 3] mean of the first half."""
    b_rgb: NDArray[np.float64]
    """[R, R, 3] mean of the second half."""


def judged_view(
    judged: Judged, variants: Mapping[str, RenderSettings], spp: int
) -> dict[str, dict[str, float]]:
    """Return the figures of one view under each setting; runs in a render child.

    Args:
        judged: the view.
        variants: settings by name.
        spp: samples per pixel of the reference, both halves together, a multiple of 128.

    Raises:
        Rejected: the scene cannot be composed, or has no light in this view.
    """
    scene = _scene(judged.scene_index)
    reference = _reference(judged.scene_index, judged.view, spp)
    found = {}
    for name, settings in variants.items():
        warm_up_kernels(scene, settings)
        warm_up_denoiser(settings.resolution)
        seed = seed_for(_SEED, "judged", judged.scene_index, judged.view, judged.sample_seed)
        started = time.process_time()
        renderer = SceneRenderer(scene, settings)
        view = renderer.render_view(*_camera(scene, judged.view), seed)
        core_s = time.process_time() - started
        found[name] = {"core_s": core_s, **figures(view, shrunk(reference, settings.resolution))}
    return found


def figures(view: RenderedView, reference: Reference) -> dict[str, float]:
    """Return stated and true errors of a picture, in dB, with what the reference leaves open."""
    mean = 0.5 * (reference.a_rgb + reference.b_rgb)
    stated_db = {
        "log": view.noise_floor_db,
        "linear": view.noise_floor_linear_db,
        "object": view.object_noise_floor_db,
    }
    found = {
        "spp": float(view.spp),
        "at_cap": float(view.at_cap),
        "brightness": 100 * float(view.radiance_rgb.mean() / mean.mean() - 1),
    }
    for name, curve in _CURVES.items():
        pixels = view.hits if name == "object" else np.ones_like(view.hits)
        true_db, open_db = true_error_db(view.radiance_rgb, reference, curve, pixels)
        excess_db = stated_db[name] - true_db
        found |= {
            f"{name}_stated_db": stated_db[name],
            f"{name}_true_db": true_db,
            f"{name}_open_db": open_db,
            f"{name}_caution_db": -excess_db,
            f"{name}_over_1": float(excess_db > 1),
            f"{name}_over_3": float(excess_db > 3),
        }
    return found


def true_error_db(
    picture_rgb: NDArray[np.float32],
    reference: Reference,
    curve: Curve,
    pixels: NDArray[np.bool_],
) -> tuple[float, float]:
    """Return a picture's error in dB, and by how many dB the reference's noise may move that.

    Args:
        picture_rgb: [R, R, 3] linear radiance.
        reference: of the same width.
        curve: what errors are taken in.
        pixels: [R, R] that count; one at least.
    """
    picture = picture_rgb.astype(np.float64)
    mean = 0.5 * (reference.a_rgb + reference.b_rgb)
    weight = np.square(secant_slope(curve, picture, mean)) * pixels[..., None] / (3 * pixels.sum())
    error = float((weight * (picture - reference.a_rgb) * (picture - reference.b_rgb)).sum())
    # The halves are off by n and -n beside the mean: (e + n)(e - n) varies by e n and n^2.
    noise_sq = np.square(0.5 * (reference.a_rgb - reference.b_rgb))
    variance = np.square(weight) * (np.square(picture - mean) + noise_sq) * noise_sq
    spread = float(np.sqrt(variance.sum()))
    error = max(error, LEAST_ERROR)
    return -10 * np.log10(error), 10 * np.log10(1 + spread / error)


def difference_db(ours: Reference, theirs: Reference, curve: Curve) -> float:
    """Return by how much two renderers differ where the noise of both is left out, in dB.

    The squared difference is the mean of (A - C) (B - D), of halves A and B of one and C and D of
    the other. It may be below 0 by chance, which counts as no difference.
    """
    means = (0.5 * (one.a_rgb + one.b_rgb) for one in (ours, theirs))
    weight = np.square(secant_slope(curve, *means))
    product = (ours.a_rgb - theirs.a_rgb) * (ours.b_rgb - theirs.b_rgb)
    return float(-10 * np.log10(max((weight * product).mean(), LEAST_ERROR)))


def shrunk(reference: Reference, resolution: int) -> Reference:
    """Return a reference of a smaller width, which divides the first."""
    return Reference(
        a_rgb=_block_means(reference.a_rgb, resolution),
        b_rgb=_block_means(reference.b_rgb, resolution),
    )


def _block_means(picture: NDArray[np.float64], resolution: int) -> NDArray[np.float64]:
    size = len(picture) // resolution
    blocks = picture.reshape(resolution, size, resolution, size, 3)
    means: NDArray[np.float64] = blocks.mean(axis=(1, 3))
    return means


@functools.lru_cache(maxsize=1)
def _scene(scene_index: int) -> Scene:
    scenes = dataclasses.replace(smoke().scenes, num_views=VIEWS)
    scene, _ = first_composed(scenes, scene_index, seed=_SEED)
    if scene is None:
        raise Rejected("no_scene", f"scene {scene_index}: every attempt was rejected")
    return scene


@functools.lru_cache(maxsize=1)
def _reference(scene_index: int, view: int, spp: int) -> Reference:
    scene = _scene(scene_index)
    pose, fov_deg = _camera(scene, view)
    camera = Camera(c2w=pose, fov_deg=fov_deg, resolution=REFERENCE_PX)
    return raw_reference(scene, camera, spp, scene_index, view)


def raw_reference(scene: Scene, camera: Camera, spp: int, *name: int) -> Reference:
    """Return two halves of raw samples of a view; runs in a render child.

    Args:
        scene: that passes `Scene.check`.
        camera: the view.
        spp: samples per pixel, both halves together, a multiple of 128.
        name: numbers that its seeds are made of.
    """
    depths = {"max_depth": RenderSettings.max_depth, "rr_depth": RenderSettings.rr_depth}
    tracer = load_tracer(scene, **depths)
    size, halves = PASS_SPP[0], []
    for half in range(2):
        total = np.zeros((camera.resolution, camera.resolution, 3))
        passes = spp // (2 * size)
        for number in range(passes):
            seed = seed_for(_SEED, "reference", *name, half, number)
            total += tracer.radiance(camera, seed=seed, spp=size)
        halves.append(total / passes)
    return Reference(a_rgb=halves[0], b_rgb=halves[1])


def _camera(scene: Scene, view: int) -> tuple[NDArray[np.float64], float]:
    return np.asarray(scene.c2w[view], np.float64), float(scene.fov_deg[view])
