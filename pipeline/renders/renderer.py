"""From a `Scene` to pictures with a measured error: the render stage itself.

A picture is sampled as two halves that share nothing. They are denoised apart to measure the floor
(pipeline.renders.noise_floor), until it reaches the target or the samples reach the cap. The
picture itself is one denoise of the mean of all samples, which is better than the mean of two.

Mitsuba is imported inside functions only: `activate` must come first.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.renders.camera import Camera
from pipeline.renders.denoiser import denoise, set_denoiser_threads
from pipeline.renders.noise_floor import NoiseFloor, measure_floor, next_spp
from pipeline.renders.settings import RenderSettings
from pipeline.renders.tracer import Features, Tracer, load_tracer
from storage.conventions import HALF_FLOAT_MAX
from storage.errors import Rejected
from storage.scene import Scene
from storage.seeds import seed_for


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderedView:
    """One finished picture and how far to trust it."""

    radiance_rgb: NDArray[np.float32]
    """[R, R, 3] linear radiance, finite, at least 0, below HALF_FLOAT_MAX; the background is 0."""
    spp: int
    """Samples per pixel that were spent."""
    noise_floor_db: float
    """Measured error as psnr_log_db."""
    noise_floor_linear_db: float
    """Measured error as psnr_linear_db."""
    object_noise_floor_db: float
    """Measured error as object_psnr_log_db, over `hits`."""
    at_cap: bool
    """Whether sampling ended at max_spp with the floor below its target."""
    hits: NDArray[np.bool_]
    """[R, R] whether the ray through the pixel's centre meets geometry (emitters do not count)."""


class SceneRenderer:
    """A scene loaded once, for any number of views of it."""

    def __init__(self, scene: Scene, settings: RenderSettings) -> None:
        """Load a scene that passes `Scene.check`; `activate` must have been called.

        Raises:
            Rejected: "unlit_scene" where no emitter has an area, "no_surfaces" where all
                triangles emit (emitters are hidden, so every picture would be black).
        """
        if scene.triangle_emits.all():
            raise Rejected("no_surfaces", f"all {scene.num_triangles} triangles are emitters")
        self._settings = settings
        self._tracer = load_tracer(scene, max_depth=settings.max_depth, rr_depth=settings.rr_depth)

    def render_view(self, c2w: ArrayLike, fov_deg: float, seed: int) -> RenderedView:
        """Return the picture of one camera; equal arguments give equal bits.

        Args:
            c2w: [4, 4] camera to world.
            fov_deg: full field of view in degrees.
            seed: any integer from 0; belongs to this view alone.

        Raises:
            Rejected: "black_view" (mean radiance of the first pass of both halves below the
                bound), "nonfinite_radiance" (found in the raw samples: the denoiser would hide
                it), "radiance_overflow" (a pixel that half floats cannot hold).
        """
        pose = np.asarray(c2w, np.float64)
        camera = Camera(c2w=pose, fov_deg=fov_deg, resolution=self._settings.resolution)
        samples = _Halves(self._tracer, camera, self._settings.pass_spp, seed)
        samples.extend_to(2 * self._settings.pass_spp)
        self._refuse_black(samples)
        samples.extend_to(self._settings.min_spp)
        aux_seed = seed_for(seed, "features")
        features = self._tracer.features(camera, seed=aux_seed, spp=self._settings.aux_spp)
        hits = self._tracer.hits(camera)
        floor = self._sample_to_target(samples, features, hits)
        picture = self._denoised(samples.mean(), features)
        if picture.max() >= HALF_FLOAT_MAX:
            raise Rejected("radiance_overflow", f"a pixel of radiance {picture.max():.3g}")
        return RenderedView(
            radiance_rgb=picture,
            spp=samples.spp,
            noise_floor_db=floor.log_db,
            noise_floor_linear_db=floor.linear_db,
            object_noise_floor_db=floor.object_log_db,
            at_cap=floor.log_db < self._settings.noise_floor_db,
            hits=hits,
        )

    def _refuse_black(self, samples: "_Halves") -> None:
        mean = float(samples.mean().mean(dtype=np.float64))
        bound = self._settings.min_mean_radiance
        if mean < bound:
            raise Rejected("black_view", f"mean radiance {mean:.2g} is below {bound:.2g}")

    def _sample_to_target(
        self, samples: "_Halves", features: Features, hits: NDArray[np.bool_]
    ) -> NoiseFloor:
        settings = self._settings
        while True:
            half_a, half_b = (self._denoised(half, features) for half in samples.half_means())
            floor = measure_floor(half_a, half_b, hits)
            gap_db = settings.noise_floor_db - floor.log_db
            if gap_db <= 0 or samples.spp == settings.max_spp:
                return floor
            step = 2 * settings.pass_spp
            samples.extend_to(
                next_spp(samples.spp, gap_db=gap_db, step=step, max_spp=settings.max_spp)
            )

    def _denoised(
        self, radiance_rgb: NDArray[np.float32], features: Features
    ) -> NDArray[np.float32]:
        if self._settings.denoiser == "off":
            return radiance_rgb
        return denoise(radiance_rgb, features, self._settings.denoiser)


class _Halves:
    """Two growing sums of passes of one view, with no sample in common."""

    def __init__(self, tracer: Tracer, camera: Camera, pass_spp: int, seed: int) -> None:
        self._tracer, self._camera, self._pass_spp, self._seed = tracer, camera, pass_spp, seed
        shape = (camera.resolution, camera.resolution, 3)
        self._sums = [np.zeros(shape), np.zeros(shape)]
        self._passes = 0

    @property
    def spp(self) -> int:
        """Samples per pixel so far, both halves together."""
        return 2 * self._passes * self._pass_spp

    def extend_to(self, spp: int) -> None:
        """Add passes to both halves until there are `spp` samples."""
        while self.spp < spp:
            for half, total in enumerate(self._sums):
                seed = seed_for(self._seed, "pass", self._passes, half)
                one = self._tracer.radiance(self._camera, seed=seed, spp=self._pass_spp)
                if not np.isfinite(one).all():
                    count = int((~np.isfinite(one)).any(axis=-1).sum())
                    raise Rejected("nonfinite_radiance", f"{count} pixels of raw samples")
                total += one
            self._passes += 1

    def half_means(self) -> list[NDArray[np.float32]]:
        return [(total / self._passes).astype(np.float32) for total in self._sums]

    def mean(self) -> NDArray[np.float32]:
        return ((self._sums[0] + self._sums[1]) / (2 * self._passes)).astype(np.float32)


def set_threads(count: int) -> None:
    """Let Mitsuba and the denoiser of this process use `count` threads; call after `activate`."""
    import drjit
    import mitsuba

    # In scalar_rgb reflections call Python (compensated_texture): threads would queue for its lock.
    drjit.set_thread_count(1 if mitsuba.variant() == "scalar_rgb" else count)
    set_denoiser_threads(count)
