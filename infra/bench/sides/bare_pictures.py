"""Pictures of few or many samples of which nothing is measured: what a network competes with.

No second half, no noise floor: a user who only wants a picture pays for its samples, the denoiser's
guide pictures and one denoise. Guide pictures of few samples go with few samples.
"""

import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from infra.bench.sides.levels import SampledPicture, SampledPictures
from infra.bench.sides.shots import SEED, warm_up_denoiser
from pipeline.renders.camera import Camera
from pipeline.renders.denoiser import denoise
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.settings import PASS_SPP, RenderSettings
from pipeline.renders.tracer import Tracer
from storage.records.scene import Scene
from storage.seeds import seed_for

_PASSES = (*PASS_SPP, 1)


def bare_pictures(
    scene: Scene, resolution: int, levels_spp: Sequence[int]
) -> tuple[SampledPictures, SampledPictures]:
    """Return a scene's first view as sampled, and denoised; runs in a render child.

    Args:
        scene: that passes `Scene.check`.
        resolution: pixels each way.
        levels_spp: rising from 1 up.
    """
    pose = np.asarray(scene.c2w[0], np.float64)
    camera = Camera(c2w=pose, fov_deg=float(scene.fov_deg[0]), resolution=resolution)
    _warm_up(_load(scene), camera)
    started = time.process_time()
    tracer = _load(scene)
    load_core_s = time.process_time() - started
    total, done, spent = np.zeros((resolution, resolution, 3)), 0, 0.0
    raw, denoised = [], []
    for spp in levels_spp:
        started = time.process_time()
        total += _sum_of_samples(tracer, camera, done, spp)
        picture = (total / spp).astype(np.float32)
        spent, done = spent + time.process_time() - started, spp
        raw.append(SampledPicture(spp=spp, radiance_rgb=picture, core_s=spent))
        started = time.process_time()
        clean = _denoised(tracer, camera, picture, spp)
        core_s = spent + time.process_time() - started
        denoised.append(SampledPicture(spp=spp, radiance_rgb=clean, core_s=core_s))
    return (
        SampledPictures(load_core_s=load_core_s, levels=tuple(raw)),
        SampledPictures(load_core_s=load_core_s, levels=tuple(denoised)),
    )


def _load(scene: Scene) -> Tracer:
    depths = {"max_depth": RenderSettings.max_depth, "rr_depth": RenderSettings.rr_depth}
    return load_tracer(scene, **depths)


def _warm_up(tracer: Tracer, camera: Camera) -> None:
    for spp in _PASSES:
        tracer.radiance(camera, seed=0, spp=spp)
        tracer.features(camera, seed=0, spp=spp)
    warm_up_denoiser(camera.resolution)


def _largest_pass(spp: int) -> int:
    return next(size for size in _PASSES if size <= spp)


def _sum_of_samples(tracer: Tracer, camera: Camera, done: int, spp: int) -> NDArray[np.float64]:
    """Return the sum of the samples from number `done` up to `spp`, [R, R, 3]."""
    total = np.zeros((camera.resolution, camera.resolution, 3))
    while done < spp:
        size = _largest_pass(spp - done)
        seed = seed_for(SEED, "bare", done)
        total += size * tracer.radiance(camera, seed=seed, spp=size).astype(np.float64)
        done += size
    return total


def _denoised(
    tracer: Tracer, camera: Camera, picture: NDArray[np.float32], spp: int
) -> NDArray[np.float32]:
    seed = seed_for(SEED, "features")
    features = tracer.features(camera, seed=seed, spp=_largest_pass(spp))
    return denoise(picture, features, "high")
