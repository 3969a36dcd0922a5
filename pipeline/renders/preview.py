"""Pictures of a fixed number of samples from one up, with one denoise: previews, of unknown error.

A measured error needs two halves of many samples (pipeline.renders.renderer). A preview has one set
of samples, so that nothing tells how far it is from the truth, and it says so.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, get_args

import numpy as np
from numpy.typing import ArrayLike

from pipeline.renders.settings import PASS_SPP, Depth, Filtered, RenderSettings, Resolution
from pipeline.renders.tracer import PixelCamera, load_tracer, pixel_camera
from pipeline.renders.view_pictures import representable, require_bounded, require_finite
from storage.denoiser import Features, Quality, denoise
from storage.errors import TrilightError
from storage.records.scene import Scene
from storage.renderer import Image, Sampling
from storage.seeds import seed_for
from storage.settings.described import checked
from storage.settings.ranges import Within

if TYPE_CHECKING:
    from pipeline.renders.vector_tracer import VectorTracer

MOST_SPP = 4096
"""Maximum number of samples of a preview; above it, use a stated error."""

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


def load_preview(
    scene: Scene, settings: PreviewSettings
) -> Callable[[ArrayLike, float, int], Iterator[Sampling | Image]]:
    """Return `preview_steps` of a pose, an angle and a seed, of a scene that is loaded once.

    The scene passes `Scene.check`; `activate` must have been called.

    Raises:
        Rejected: "unlit_scene" or "no_surfaces", as of `SceneRenderer`.
    """
    tracer = load_tracer(scene, max_depth=settings.max_depth, rr_depth=settings.rr_depth)

    def view_steps(c2w: ArrayLike, fov_deg: float, seed: int) -> Iterator[Sampling | Image]:
        camera = pixel_camera(c2w, fov_deg, settings.resolution)
        return preview_steps(tracer, camera, seed, settings.spp, settings.denoiser)

    return view_steps


def preview_steps(
    tracer: "VectorTracer", camera: PixelCamera, seed: int, spp: int, denoiser: Filtered
) -> Iterator[Sampling | Image]:
    """Yield after each pass, and last the picture; equal arguments give equal bits.

    Raises:
        Rejected: "nonfinite_radiance" or "radiance_overflow", as of `SceneRenderer`.
    """
    began_s = time.process_time()
    total = np.zeros((camera.resolution, camera.resolution, 3))
    done = 0
    for size in pass_sizes(spp):
        picture = tracer.radiance(camera, seed=seed_for(seed, "preview", done), spp=size)
        total += size * picture.astype(np.float64)
        done += size
        yield Sampling(spp=done, expected_spp=spp, missing_db=None)
    mean = (total / done).astype(np.float32)
    require_finite(int((~np.isfinite(mean)).any(axis=-1).sum()))
    require_bounded(float(mean.max()))
    if denoiser != "off":
        mean = denoise(mean, tracer.features(camera, spp=guide_rays(done)), denoiser)
    yield Image(
        radiance_rgb=representable(mean),
        samples=done,
        cpu_seconds=time.process_time() - began_s,
        facts={"spp": done},
        remark="a preview: its error is not measured",
    )


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


_PASS = "pass of {}".format
_GUIDES = "guides of {}".format
SCENE = "scene"
"""Loading the scene, once for all pictures of it."""

_REPEATS = 3
_LEAST_S = 0.2
"""A part that takes longer than this is timed once: what varies is small beside it."""
_SMALL = 32
_SEED = 20_261_124


def preview_parts(spp: int, denoiser: Filtered) -> Counter[str]:
    """Return how often each part occurs in a preview, by name, without loading the scene."""
    parts = Counter(_PASS(size) for size in pass_sizes(spp))
    if denoiser != "off":
        parts.update([_GUIDES(guide_rays(spp)), denoiser])
    return parts


def timed_parts(
    scene: Scene, resolution: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """Return the seconds of every part for the scene's first view; `activate` has been called.

    Args:
        scene: that passes `Scene.check`, with a camera.
        resolution: pixels each way.
        clock: returns seconds; `time.process_time` counts those of all threads.
    """
    load_tracer(scene)  # the first one loads libraries as well
    began = clock()
    tracer = load_tracer(scene)
    seconds = {SCENE: clock() - began}
    small, camera = (
        pixel_camera(scene.c2w[0], scene.fov_deg[0], px) for px in (_SMALL, resolution)
    )
    for size in PASSES:
        tracer.radiance(small, seed=_SEED, spp=size)  # kernels are compiled, or read from disk
        seconds[_PASS(size)] = _median_s(
            clock, partial(tracer.radiance, camera, seed=_SEED, spp=size)
        )
    for rays in PASS_SPP[1:]:
        tracer.features(small, spp=rays)
        seconds[_GUIDES(rays)] = _median_s(clock, partial(tracer.features, camera, spp=rays))
    picture = tracer.radiance(camera, seed=_SEED, spp=1)
    features = tracer.features(camera, spp=4)
    grey = np.ones((resolution, resolution, 3), np.float32)
    for quality in get_args(Quality):
        denoise(grey, Features(albedo=grey, normal=grey), quality)  # the filter is built
        seconds[quality] = _median_s(clock, partial(denoise, picture, features, quality))
    return seconds


def _median_s(clock: Callable[[], float], part: Callable[[], Any]) -> float:
    seconds = list[float]()
    while len(seconds) < _REPEATS and max(seconds, default=0) < _LEAST_S:
        began = clock()
        part()
        seconds.append(clock() - began)
    return float(np.median(seconds))


def all_parts() -> tuple[str, ...]:
    """Return the names of all parts, in the order in which they are timed."""
    passes = map(_PASS, PASSES)
    guides = map(_GUIDES, PASS_SPP[1:])
    return (SCENE, *passes, *guides, *get_args(Quality))


FIRST_LOOKS_SPP = (1, 4, 16)
"""Samples of the previews; each is a picture of its own, and together they cost less than a third
of the samples before the first measurement."""


def samples_text(spp: int) -> str:
    """Return a number of samples as text, such as `4 samples`."""
    return f"{spp} sample{'s' if spp > 1 else ''}"
