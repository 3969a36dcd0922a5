"""Films of a scene by each rung, and how they flicker: held against raw halves, as errors are.

With E the error of log10(1 + radiance) of a frame, flicker is the mean square of the change of E
from one frame to the next (storage.metrics.flicker_log_db). Raw halves A and B of each frame give
two such changes whose noises have nothing to do with each other: in the mean of their product the
noise of the references cancels. What is left of it is that the mean of noisy logarithms lies below
the logarithm of the mean, which hardly changes from frame to frame. (Secants, as errors of single
pictures are taken with, are worse here: one bright sample in one half flattens the secant of both,
and where the noise is as large as the flicker the product then comes out below 0.)
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from infra.bench.sides.judged_pictures import LEAST_ERROR, Reference
from infra.bench.sides.rung_pictures import Rung, sampled_rung
from infra.bench.sides.shots import warm_up_denoiser
from infra.rendering.cameras import orbit, own_camera
from pipeline.renders.settings import Filtered
from storage.conventions import log10_radiance
from storage.records.scene import Scene


@dataclass(frozen=True, kw_only=True, eq=False)
class Film:
    """The views of a scene, one after the other."""

    frames_rgb: NDArray[np.float32]
    """[N, R, R, 3] linear radiance."""
    view_s: float
    """Median core-seconds of a view, of a scene that is loaded and was shown once."""


def with_orbit(scene: Scene, frames: int, arc_deg: float) -> Scene:
    """Return a scene with the cameras of `trilight render --orbit` for cameras of its own."""
    cameras = orbit(scene, own_camera(scene, 0), frames, arc_deg)
    c2w = np.stack([camera.c2w for camera in cameras])
    return scene.with_cameras(c2w, np.array([camera.fov_deg for camera in cameras], np.float32))


def film(rung: Rung, scene: Scene) -> Film:
    """Return a rung's pictures of all cameras of a scene."""
    view = rung(scene)
    view(scene.c2w[0], float(scene.fov_deg[0]))  # warms up
    frames, spent = [], []
    for c2w, fov_deg in zip(scene.c2w, scene.fov_deg, strict=True):
        began = time.process_time()
        frames.append(view(c2w, float(fov_deg)))
        spent.append(time.process_time() - began)
    return Film(frames_rgb=np.stack(frames), view_s=float(np.median(spent)))


def sampled_films(
    scene: Scene, resolution: int, wanted: Sequence[tuple[int, Filtered, bool]]
) -> list[Film]:
    """Return films by samples a pixel, filter, and whether each frame has noise of its own.

    Runs in a render child.
    """
    warm_up_denoiser(resolution)
    return [
        film(sampled_rung(resolution, spp, filtered, new_noise=new_noise), scene)
        for spp, filtered, new_noise in wanted
    ]


def true_flicker_db(
    frames_rgb: NDArray[np.float32], references: Sequence[Reference]
) -> tuple[float, float]:
    """Return a film's flicker in dB, and by how many dB the references' noise may move that.

    Args:
        frames_rgb: [N, R, R, 3] linear radiance, two frames at least.
        references: of each frame, of the same width.
    """
    shown = log10_radiance(frames_rgb.astype(np.float64))
    halves = ([each.a_rgb for each in references], [each.b_rgb for each in references])
    a, b = (np.diff(shown - log10_radiance(np.stack(half)), axis=0) for half in halves)
    flicker = float((a * b).mean())
    change, noise_sq = 0.5 * (a + b), np.square(0.5 * (a - b))
    spread = float(np.sqrt(((np.square(change) + noise_sq) * noise_sq).sum())) / a.size
    flicker = max(flicker, LEAST_ERROR)
    return -10 * np.log10(flicker), 10 * np.log10(1 + spread / flicker)
