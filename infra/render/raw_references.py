"""Raw references without denoising, and the true errors of pictures against them.

A reference is two independent halves of raw samples, A and B. For smaller pictures, blocks of its
pixels are averaged, which adds their samples. The squared error of a picture P is the mean of
(P - A) (P - B): the noise of A and of B is independent, so that it cancels on average and neither
half needs to be converged. Errors in a tone curve are multiplied by the slope of the curve's secant
between the picture and the mean of both halves, as in pipeline.renders.noise_floor.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.camera import PixelCamera
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.noise_floor import Curve, secant_slope
from pipeline.renders.settings import PASS_SPP, RenderSettings
from pipeline.renders.tracer import Tracer
from storage.records.lights import light_rows, num_light_pictures
from storage.records.scene import Scene
from storage.seeds import seed_for

_SEED = 20_261_124
"""Seed of the references' samples; no dataset preset and no run uses it."""

LEAST_ERROR = 1e-10
"""Squared errors below this, or below 0 by chance, count as this: 100 dB."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RawReference:
    """Two independent halves of raw samples."""

    a_rgb: NDArray[np.float64]
    """[R, R, 3] mean of the first half."""
    b_rgb: NDArray[np.float64]
    """[R, R, 3] mean of the second half."""


def first_camera(scene: Scene, resolution: int) -> PixelCamera:
    """Return the first camera of a scene for square pictures of `resolution` pixels."""
    pose = np.asarray(scene.c2w[0], np.float64)
    return PixelCamera(c2w=pose, fov_deg=float(scene.fov_deg[0]), resolution=resolution)


def raw_reference(scene: Scene, camera: PixelCamera, spp: int, *name: int) -> RawReference:
    """Return two halves of raw samples of a view; runs in a render child.

    Args:
        spp: samples per pixel of both halves together, a multiple of 128.
        name: numbers that the seeds are derived from.
    """
    return _reference(_tracer(scene), camera, spp, *name)


def light_references(scene: Scene, camera: PixelCamera, spp: int) -> list[RawReference]:
    """Return a `raw_reference` of each light alone (storage.records.lights)."""
    tracer = _tracer(scene)
    rows: list[int | None] = list(light_rows(scene))
    rows += [None] * (num_light_pictures(scene) - len(rows))
    return [_reference(tracer.only_light(row), camera, spp) for row in rows]


def _tracer(scene: Scene) -> Tracer:
    depths = {"max_depth": RenderSettings.max_depth, "rr_depth": RenderSettings.rr_depth}
    return load_tracer(scene, **depths)


def _reference(tracer: Tracer, camera: PixelCamera, spp: int, *name: int) -> RawReference:
    size = PASS_SPP[0]
    halves = []
    for half in range(2):
        total = np.zeros((camera.resolution, camera.resolution, 3))
        passes = spp // (2 * size)
        for number in range(passes):
            seed = seed_for(_SEED, "reference", *name, half, number)
            total += tracer.radiance(camera, seed=seed, spp=size)
        halves.append(total / passes)
    return RawReference(a_rgb=halves[0], b_rgb=halves[1])


def true_error_db(
    picture_rgb: NDArray[np.float32],
    reference: RawReference,
    curve: Curve,
    pixels: NDArray[np.bool_],
) -> tuple[float, float]:
    """Return a picture's error in dB, and its standard deviation in dB by the reference's noise.

    Args:
        picture_rgb: [R, R, 3] linear radiance.
        reference: reference of the same width.
        curve: tone curve in which errors are taken.
        pixels: [R, R] mask of the pixels that count, at least one.
    """
    picture = picture_rgb.astype(np.float64)
    mean = 0.5 * (reference.a_rgb + reference.b_rgb)
    weight = np.square(secant_slope(curve, picture, mean)) * pixels[..., None] / (3 * pixels.sum())
    error = float((weight * (picture - reference.a_rgb) * (picture - reference.b_rgb)).sum())
    # With M the mean of both halves, A = M + n and B = M - n; e = P - M is the picture's error. So
    # (P - A)(P - B) = (e - n)(e + n) = e^2 - n^2, and a pixel's variance is about (e^2 + n^2) n^2:
    # the error times the noise (e n)^2, and the noise's own n^4. Pixels are independent.
    noise_sq = np.square(0.5 * (reference.a_rgb - reference.b_rgb))
    variance = np.square(weight) * (np.square(picture - mean) + noise_sq) * noise_sq
    spread = float(np.sqrt(variance.sum()))
    error = max(error, LEAST_ERROR)
    return -10 * np.log10(error), 10 * np.log10(1 + spread / error)
