"""Reference pictures (ground truth) without denoising, and the true errors of pictures.

A reference is two independent halves of raw samples, A and B. For smaller pictures, blocks of its
pixels are averaged, which adds their samples. The squared error of a picture P is the mean of
(P - A) (P - B): the noise of A and of B is independent, so that it cancels on average and neither
half needs to be converged. Errors in a tone curve are multiplied by the slope of the curve's secant
between the picture and the mean of both halves, as in pipeline.renders.noise_floor.
"""

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.calibrated_error import LEAST_ERROR
from pipeline.renders.noise_floor import Curve, secant_slope
from pipeline.renders.settings import PASS_SPP
from pipeline.renders.tracer import PixelCamera, load_tracer, pixel_camera
from storage.records.lights import light_sources
from storage.records.scene import Scene
from storage.seeds import seed_for

_SEED = 20_261_124
"""Seed of the references' samples; no dataset preset and no run uses it."""


RawReference = NDArray[np.float64]
"""[2, R, R, 3] linear radiance: the means of two independent halves of raw samples."""


def first_camera(scene: Scene, resolution: int) -> PixelCamera:
    """Return the first camera of a scene for square pictures of `resolution` pixels."""
    return pixel_camera(scene.c2w[0], scene.fov_deg[0], resolution)


def raw_reference(scene: Scene, camera: PixelCamera, spp: int, *name: int) -> RawReference:
    """Return two halves of raw samples of a view; runs in a render child.

    Args:
        spp: samples per pixel of both halves together, a multiple of 128.
        name: numbers that the seeds are derived from.
    """
    return _reference(load_tracer(scene), camera, spp, *name)


def light_references(scene: Scene, camera: PixelCamera, spp: int) -> NDArray[np.float64]:
    """Return the `raw_reference` of each light alone (storage.records.lights), [L, 2, R, R, 3]."""
    tracer = load_tracer(scene)
    lights = light_sources(scene)
    return np.stack([_reference(tracer.only_light(row), camera, spp) for row in lights])


def _reference(tracer: Any, camera: PixelCamera, spp: int, *name: int) -> RawReference:
    size = PASS_SPP[0]
    passes = spp // (2 * size)
    halves = np.zeros((2, camera.resolution, camera.resolution, 3))
    for half, number in itertools.product(range(2), range(passes)):
        seed = seed_for(_SEED, "reference", *name, half, number)
        halves[half] += tracer.radiance(camera, seed=seed, spp=size)
    return halves / passes


def true_error(
    picture_rgb: NDArray[np.float32],
    reference: RawReference,
    curve: Curve,
    pixels: NDArray[np.bool_],
) -> tuple[float, float]:
    """Return a picture's mean squared error, and its standard deviation by the reference's noise.

    The error may be below 0 by chance.

    Args:
        picture_rgb: [R, R, 3] linear radiance.
        reference: reference of the same width.
        curve: tone curve in which errors are taken.
        pixels: [R, R] mask of the pixels that count, at least one.
    """
    picture = picture_rgb.astype(np.float64)
    mean = reference.mean(axis=0)
    noise = 0.5 * (reference[0] - reference[1])
    weight = np.square(secant_slope(curve, picture, mean)) * pixels[..., None] / (3 * pixels.sum())
    error = float((weight * (np.square(picture - mean) - np.square(noise))).sum())
    # With M = T + m the mean of both halves, A = M + n and B = M - n, where m and n are independent
    # and of one variance v. With e = P - T, (P - A)(P - B) = (e - m)^2 - n^2 has the variance
    # 4 e^2 v + 4 v^2, which is 4 (P - M)^2 n^2 on average. The channels of a pixel have the same
    # paths, so their products are added before they are squared. Pixels are independent.
    products = (weight * (picture - mean) * noise).sum(axis=-1)
    return error, float(2 * np.sqrt(np.square(products).sum()))


def true_error_db(
    picture_rgb: NDArray[np.float32],
    reference: RawReference,
    curve: Curve,
    pixels: NDArray[np.bool_] | None = None,
) -> tuple[float, float]:
    """Return `true_error` and its standard deviation in dB; by default all pixels count."""
    if pixels is None:
        pixels = np.ones(picture_rgb.shape[:2], np.bool_)
    error, spread = true_error(picture_rgb, reference, curve, pixels)
    error = max(error, LEAST_ERROR)
    return -10 * np.log10(error), 10 * np.log10(1 + spread / error)
