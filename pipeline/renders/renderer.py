"""`SceneRenderer`: pictures of a scene with a measured error.

It renders the camera that it is given, or refuses its picture; who chooses cameras, and which one
comes next, is not known here (pipeline.making.render_sample).

A picture is sampled as two halves that share nothing. They are denoised apart to measure its floors
(pipeline.renders.noise_floor), until these reach their targets or the samples reach the cap
(pipeline.renders.stopping). The picture itself is one denoise of the mean of all samples, which is
better than the mean of two. With `per_light` all of this is done for each emitter alone, and the
picture is their sum.

Mitsuba is imported inside functions only: `activate` must come first.
"""

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.renders.camera import Camera
from pipeline.renders.denoiser import denoise, set_denoiser_threads
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.noise_floor import Half, MeasuredFloor, measure_floor
from pipeline.renders.samples import HalfSamples
from pipeline.renders.settings import RenderSettings
from pipeline.renders.stopping import Floors, Goal, expected_spp, gaps_db, next_spp
from pipeline.renders.tracer import Features, Tracer
from storage.conventions import HALF_FLOAT_MAX
from storage.errors import Rejected
from storage.records.lights import MAX_LIGHTS, light_rows, rounded_to_half, sum_of_lights
from storage.records.scene import Scene
from storage.seeds import seed_for


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderedView:
    """One finished picture and how far to trust it."""

    radiance_rgb: NDArray[np.float32]
    """[R, R, 3] linear radiance, finite, at least 0, below HALF_FLOAT_MAX; the background is 0."""
    spp: int
    """Samples per pixel that were spent; on each light where they are apart."""
    noise_floor_db: float
    """Measured error as psnr_log_db."""
    noise_floor_linear_db: float
    """Measured error as psnr_linear_db."""
    object_noise_floor_db: float
    """Measured error as object_psnr_log_db, over `hits`."""
    at_cap: bool
    """Whether sampling ended at max_spp with a floor below its target."""
    hits: NDArray[np.bool_]
    """[R, R] whether the ray through the pixel's centre meets geometry (emitters do not count)."""
    lights_rgb: NDArray[np.float32] | None = None
    """With `per_light`: [L, R, R, 3] radiance of each emitter object alone, rounded to half floats;
    `radiance_rgb` is their storage.records.lights.sum_of_lights in every bit."""


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """How far the sampling of a view has come."""

    spp: int
    """Samples per pixel so far."""
    expected_spp: int
    """Samples at which all targets should be reached, or the cap; a guess that improves."""
    missing_db: float | None
    """The widest gap to a target when the floors were measured last; None before that."""


_MAX_RAW = 1e13
"""Raw pixels from this radiance on are refused: half floats could not hold the picture even if the
denoiser spread one of them over 8192 x 8192 pixels. From about 5e36 on the denoiser returns black,
which would hide the overflow."""


class SceneRenderer:
    """A scene loaded once, for any number of views of it."""

    def __init__(self, scene: Scene, settings: RenderSettings) -> None:
        """Load a scene that passes `Scene.check`; `activate` must have been called.

        Raises:
            Rejected: "unlit_scene" where no emitter has an area (with `per_light`: where one has
                none), "no_surfaces" where all triangles emit (emitters are hidden, so every
                picture would be black), "too_many_lights" beyond MAX_LIGHTS with `per_light`.
        """
        if scene.triangle_emits.all():
            raise Rejected("no_surfaces", f"all {scene.num_triangles} triangles are emitters")
        self._settings = settings
        self._tracer = load_tracer(scene, max_depth=settings.max_depth, rr_depth=settings.rr_depth)
        self._parts = [self._tracer]
        if settings.per_light:
            self._parts = _tracer_of_each_light(self._tracer, scene)

    def render_view(self, c2w: ArrayLike, fov_deg: float, seed: int) -> RenderedView:
        """Return the picture of one camera; equal arguments give equal bits.

        Args:
            c2w: [4, 4] camera to world.
            fov_deg: full field of view in degrees.
            seed: any integer from 0; belongs to this view alone.

        Raises:
            Rejected: "black_view" (mean radiance of the first pass of both halves below the
                bound), "nonfinite_radiance" (found in the raw samples: the denoiser would hide
                it), "radiance_overflow" (a pixel that half floats cannot hold),
                "floor_not_reached" (at max_spp, with `reject_at_cap`).
        """
        steps = self.view_steps(c2w, fov_deg, seed)
        while True:
            try:
                next(steps)
            except StopIteration as end:
                view: RenderedView = end.value
                return view

    def view_steps(
        self, c2w: ArrayLike, fov_deg: float, seed: int
    ) -> Generator[Sampling, None, RenderedView]:
        """Do what `render_view` does, yielding after each pass of one half."""
        settings = self._settings
        pose = np.asarray(c2w, np.float64)
        camera = Camera(c2w=pose, fov_deg=fov_deg, resolution=settings.resolution)
        settled = settings.min_spp
        samples = HalfSamples(
            self._parts, camera, seed, first_spp=settled, max_spp=settings.max_spp
        )
        first_pass_of_both = 2 * samples.pass_spp
        for _ in samples.passes_to(first_pass_of_both):
            yield Sampling(spp=samples.spp, expected_spp=settled, missing_db=None)
        self._refuse_black(samples)
        for _ in samples.passes_to(settled):
            yield Sampling(spp=samples.spp, expected_spp=settled, missing_db=None)
        aux_seed = seed_for(seed, "features")
        features = self._tracer.features(camera, seed=aux_seed, spp=settings.aux_spp)
        hits = self._tracer.hits(camera)
        floor = yield from self._sample_to_targets(samples, features, hits)
        self._refuse_noisy(floor)
        parts = self._denoised(samples.mean(), features)
        lights = rounded_to_half(_representable(parts)) if settings.per_light else None
        picture = parts[0] if lights is None else sum_of_lights(lights)
        return RenderedView(
            radiance_rgb=_representable(picture),
            spp=samples.spp,
            noise_floor_db=floor.log_db,
            noise_floor_linear_db=floor.linear_db,
            object_noise_floor_db=floor.object_log_db,
            at_cap=bool(gaps_db(settings.targets_db, _by_metric(floor))),
            hits=hits,
            lights_rgb=lights,
        )

    def _refuse_black(self, samples: HalfSamples) -> None:
        mean = float(samples.mean().sum(axis=0).mean(dtype=np.float64))
        bound = self._settings.min_mean_radiance
        if mean < bound:
            raise Rejected("black_view", f"mean radiance {mean:.2g} is below {bound:.2g}")

    def _refuse_noisy(self, floor: MeasuredFloor) -> None:
        targets_db, floors_db = self._settings.targets_db, _by_metric(floor)
        missed = [
            f"{metric} is {floors_db[metric]:.1f} dB; expected {targets_db[metric]:g}"
            for metric in gaps_db(targets_db, floors_db)
        ]
        if self._settings.reject_at_cap and missed:
            raise Rejected("floor_not_reached", ", ".join(missed))

    def _sample_to_targets(
        self, samples: HalfSamples, features: Features, hits: NDArray[np.bool_]
    ) -> Generator[Sampling, None, MeasuredFloor]:
        targets_db, max_spp = self._settings.targets_db, self._settings.max_spp
        measured: list[tuple[int, Floors]] = []
        while True:
            half_a, half_b = (self._half(raw, features) for raw in samples.half_means())
            floor = measure_floor(half_a, half_b, hits, samples.spp)
            measured.append((samples.spp, _by_metric(floor)))
            gaps = gaps_db(targets_db, _by_metric(floor))
            if not gaps or samples.spp == max_spp:
                return floor
            goal = Goal(targets_db=targets_db, step=2 * samples.pass_spp, max_spp=max_spp)
            expected, missing_db = expected_spp(measured, goal), max(gaps.values())
            for _ in samples.passes_to(next_spp(measured, goal)):
                yield Sampling(spp=samples.spp, expected_spp=expected, missing_db=missing_db)

    def _half(self, raw_rgb: NDArray[np.float32], features: Features) -> Half:
        denoised = self._denoised(raw_rgb, features)
        return Half(raw_rgb=raw_rgb.sum(axis=0), denoised_rgb=denoised.sum(axis=0))

    def _denoised(self, parts_rgb: NDArray[np.float32], features: Features) -> NDArray[np.float32]:
        """Return the parts [P, R, R, 3] without noise; raises Rejected("radiance_overflow").

        Lights apart are shares of one denoised picture, pixel by pixel and channel by channel: of
        all light together, in proportion to what each is when it is denoised alone. The sum of
        pictures that were denoised alone carries the bias of each: in four scenes it was 1.7 to 5.2
        dB worse than this one, and claimed a floor up to 5.9 dB better than the truth (docs/log).
        """
        quality = self._settings.denoiser
        if parts_rgb.max() >= _MAX_RAW:
            raise Rejected("radiance_overflow", f"a raw pixel of radiance {parts_rgb.max():.3g}")
        if quality == "off":
            return parts_rgb
        if not self._settings.per_light:
            return denoise(parts_rgb[0], features, quality)[None]
        alone = np.stack([denoise(part, features, quality) for part in parts_rgb])
        together = denoise(parts_rgb.sum(axis=0), features, quality)
        return together * _shares_of(alone)


def _by_metric(floor: MeasuredFloor) -> Floors:
    return {
        "psnr_log_db": floor.log_db,
        "psnr_linear_db": floor.linear_db,
        "object_psnr_log_db": floor.object_log_db,
    }


def _tracer_of_each_light(tracer: Tracer, scene: Scene) -> list[Tracer]:
    rows = light_rows(scene)
    if len(rows) > MAX_LIGHTS:
        raise Rejected("too_many_lights", f"{len(rows)} emitters apart; at most {MAX_LIGHTS}")
    return [tracer.only_light(row) for row in rows]


def _shares_of(parts_rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return what share of their sum each of P parts [P, ...] is: equal ones where all are 0."""
    total = parts_rgb.sum(axis=0, dtype=np.float64)
    equal = np.full(parts_rgb.shape, 1 / len(parts_rgb))
    return np.divide(parts_rgb, total, out=equal, where=total > 0).astype(np.float32)


def _representable(radiance_rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return radiance that half floats can hold; raises Rejected("radiance_overflow") else."""
    if radiance_rgb.max() >= HALF_FLOAT_MAX:
        raise Rejected("radiance_overflow", f"a pixel of radiance {radiance_rgb.max():.3g}")
    return radiance_rgb


def set_threads(count: int) -> None:
    """Let Mitsuba and the denoiser of this process use `count` threads; call after `activate`."""
    import drjit
    import mitsuba

    # In scalar_rgb reflections call Python (compensated_texture): threads would queue for its lock.
    drjit.set_thread_count(1 if mitsuba.variant() == "scalar_rgb" else count)
    set_denoiser_threads(count)
