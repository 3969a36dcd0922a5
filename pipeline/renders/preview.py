"""Pictures of a fixed number of samples from one up, with one denoise: previews, of unknown error.

A measured error needs two halves of many samples (pipeline.renders.renderer). A preview has one set
of samples, so that nothing tells how far it is from the truth, and it says so.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.renders.camera import PixelCamera
from pipeline.renders.denoiser import denoise
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.renderer import representable, require_surfaces
from pipeline.renders.settings import PASS_SPP, Depth, Filtered, RenderSettings, Resolution
from pipeline.renders.tracer import Tracer
from pipeline.renders.view_pictures import require_bounded
from storage.errors import Rejected, TrilightError
from storage.records.scene import Scene
from storage.renderer import Sampling
from storage.seeds import seed_for
from storage.settings.described import checked
from storage.settings.ranges import Within

MOST_SPP = 4096
"""Maximum number of samples of a preview; above it, use a noise floor."""

FAST_SPP = 16
"""Up to so many samples the fast filter is the better trade: more samples cost less than the better
filter, 0.5 core-seconds at 256 pixels, and bring as much (study S21)."""


def usual_filter(spp: int) -> Filtered:
    """Return the default quality of Open Image Denoise for a number of samples."""
    return "fast" if spp <= FAST_SPP else "high"


PASSES = (*PASS_SPP, 1)
"""Samples of a pass, the largest first."""


@checked("preview settings")
class PreviewSettings:
    """Settings of a preview."""

    resolution: Resolution
    """Width and height in pixels, a multiple of 8."""
    spp: Annotated[int, Within(1, MOST_SPP, unit="samples")]
    """Number of samples of each pixel."""
    denoiser: Filtered = "fast"
    """Quality of Open Image Denoise."""
    max_depth: Depth = RenderSettings.max_depth
    """Maximum length of a path in edges; 2 is direct light."""
    rr_depth: Depth = RenderSettings.rr_depth
    """Depth in edges from which Russian roulette may end a path."""

    def __post_init__(self) -> None:
        if self.resolution % 8 != 0:
            raise TrilightError(
                f"preview settings: resolution is {self.resolution}; expected a multiple of 8."
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class Preview:
    """A picture without a measured error."""

    radiance_rgb: NDArray[np.float32]
    """[R, R, 3] linear radiance that half floats can hold."""
    spp: int
    """Number of samples of each pixel."""
    core_s: float
    """Core-seconds that the picture took, without loading the scene."""


class PreviewRenderer:
    """A scene loaded once, for previews of any of its views."""

    def __init__(self, scene: Scene, settings: PreviewSettings) -> None:
        """Load a scene that passes `Scene.check`; `activate` must have been called.

        Raises:
            Rejected: "unlit_scene" or "no_surfaces", as of `SceneRenderer`.
        """
        require_surfaces(scene)
        self._settings = settings
        self._tracer = load_tracer(scene, max_depth=settings.max_depth, rr_depth=settings.rr_depth)

    def view_steps(self, c2w: ArrayLike, fov_deg: float, seed: int) -> Iterator[Sampling | Preview]:
        """Yield after each pass, and last the picture; equal arguments give equal bits.

        Raises:
            Rejected: "nonfinite_radiance" or "radiance_overflow", as of `SceneRenderer`.
        """
        settings = self._settings
        pose = np.asarray(c2w, np.float64)
        camera = PixelCamera(c2w=pose, fov_deg=fov_deg, resolution=settings.resolution)
        return preview_steps(self._tracer, camera, seed, settings.spp, settings.denoiser)


def preview_steps(
    tracer: Tracer, camera: PixelCamera, seed: int, spp: int, denoiser: Filtered
) -> Iterator[Sampling | Preview]:
    """Do what `PreviewRenderer.view_steps` does, for a scene that a tracer has loaded."""
    began_s = time.process_time()
    total = np.zeros((camera.resolution, camera.resolution, 3))
    done = 0
    for size in pass_sizes(spp):
        picture = tracer.radiance(camera, seed=seed_for(seed, "preview", done), spp=size)
        total += size * picture.astype(np.float64)
        done += size
        yield Sampling(spp=done, expected_spp=spp, missing_db=None)
    mean = (total / done).astype(np.float32)
    if not np.isfinite(mean).all():
        broken = int((~np.isfinite(mean)).any(axis=-1).sum())
        raise Rejected("nonfinite_radiance", f"{broken} pixels of raw samples")
    require_bounded(float(mean.max()))
    if denoiser != "off":
        mean = denoise(mean, tracer.features(camera, spp=guide_rays(done)), denoiser)
    yield Preview(radiance_rgb=representable(mean), spp=done, core_s=time.process_time() - began_s)


def pass_sizes(spp: int) -> Iterator[int]:
    """Yield the samples of each pass of a preview, the largest first; they add up to `spp`."""
    while spp > 0:
        size = next(size for size in PASSES if size <= spp)
        spp -= size
        yield size


def guide_rays(spp: int) -> int:
    """Return the rays of a pixel for the guide pictures of a preview of `spp` samples."""
    # 4 rays cost as much as 1 and are 0.3 (fast) to 0.9 dB better; 16 pay from 16 samples on
    return PASS_SPP[1] if spp >= PASS_SPP[1] else PASS_SPP[2]
