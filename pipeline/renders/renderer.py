"""`SceneRenderer`: pictures of a scene with a measured error.

It renders the camera that it is given, or refuses its picture; who chooses cameras, and which one
comes next, is not known here (pipeline.generation.scene_worker).

A picture is sampled as two halves that share nothing. They are denoised apart to measure its floors
(pipeline.renders.noise_floor), until these reach their targets or the samples reach the cap
(pipeline.renders.samples); from the second measurement on, the tiles that need more samples get
more (pipeline.renders.samples). The picture itself is one denoise of the mean of all
samples, which is better than the mean of two. With `per_light` all of this is done for each emitter
and the sky alone, and the picture is their sum; with `split` direct and indirect light are kept
apart, and it is theirs.

Mitsuba is imported inside functions only: `activate` must come first.
"""

import time
from collections import deque
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.renders.calibrated_error import first_spp
from pipeline.renders.noise_floor import by_metric
from pipeline.renders.pictures import ViewPictures
from pipeline.renders.preview import FIRST_LOOKS_SPP, preview_steps, usual_filter
from pipeline.renders.samples import (
    DualBuffer,
    Floors,
    TileChoice,
    expected_spp,
    gaps_db,
    next_spp,
)
from pipeline.renders.settings import FIRST_SPP, RenderSettings
from pipeline.renders.tracer import PixelCamera, load_tracer, pixel_camera
from pipeline.renders.view_pictures import MeasuredLook, representable
from storage.denoiser import set_denoiser_threads
from storage.errors import Rejected
from storage.records.lights import (
    MAX_LIGHTS,
    Parts,
    light_sources,
    rounded_to_half,
    sum_of_lights,
)
from storage.records.sample import PictureErrors
from storage.records.scene import Scene
from storage.renderer import Image, Sampling

Result = TypeVar("Result")

_FAST_HALVES_SPP = 256
"""Up to so many samples the halves are denoised by the fast filter, whose own error makes the floor
0.3 to 0.5 dB more careful. Of more, that error would hold floors back by a decibel and more, and a
look with the best filter costs less than a twentieth of the samples."""


_GUIDED_SPP = 512
"""A view that is expected to need so many samples is guided from then on: learning the scene and
slower passes cost easier ones 7 to 11 %."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderedView(PictureErrors):
    """One finished picture with its measured error."""

    radiance_rgb: NDArray[np.float32]
    """[R, R, 3] linear radiance, finite, at least 0, below HALF_FLOAT_MAX; the background is 0."""
    spp: int
    """Samples per pixel that were spent, on each light where they are apart: the mean over the
    pixels that show anything, rounded down."""
    expected_error: PictureErrors | None = None
    """Errors that are as often better as worse, in dB, where the three above are calibrated bounds
    (pipeline.renders.calibrated_error); None where they are bounds by estimate and allowances."""
    at_cap: bool
    """True if sampling ended at max_spp with a floor below its target."""
    core_s: float
    """Core-seconds that the picture took, without its looks and without loading the scene."""
    hits: NDArray[np.bool_]
    """[R, R] true where the ray through a pixel's center hits geometry other than emitters."""
    lights_rgb: NDArray[np.float32] | None = None
    """[L, R, R, 3] radiance of each emitter object and then of the sky alone, with `per_light`;
    rounded to half floats.
    `radiance_rgb` is their storage.records.lights.sum_of_lights in every bit."""
    parts_rgb: Parts | None = None
    """[R, R, 3] radiance of each part, with `split` or `split_lobes`; rounded to half floats. With
    `per_light` [L, R, R, 3]. Their storage.records.lights.sum_of_parts is `radiance_rgb`, or
    `lights_rgb`, in every bit."""
    part_floors: Mapping[str, PictureErrors] | None = None
    """Measured error of each part, of all lights together."""
    light_floors: Sequence[PictureErrors] | None = None
    """Measured error of each of `lights_rgb`."""


def few_samples_remark(spp: int) -> str:
    """Return the remark beside a picture whose error is a bound; empty for enough samples."""
    return f"below {FIRST_SPP} samples the stated error may flatter" if spp < FIRST_SPP else ""


def run_to_end(steps: Iterator[Sampling | Result]) -> Result:
    """Return what a rendering yields last, its result, without the progress before."""
    return cast(Result, deque(steps, maxlen=1).pop())


class SceneRenderer:
    """A scene loaded once, for any number of views of it."""

    def __init__(
        self,
        scene: Scene,
        settings: RenderSettings,
        *,
        shows_looks: bool = False,
        light_seed: int | None = None,
    ) -> None:
        """Load a scene that passes `Scene.check`; `activate` must have been called.

        Args:
            shows_looks: whether `view_steps` yields pictures that appear at once and then improve:
                previews of few samples, whose error is unknown, and one after each measurement by
                which a target is missed, which costs one denoise. Their CPU seconds are those of a
                picture as good, without the looks before it. The picture at the end is the same,
                bit by bit.
            light_seed: of the light paths of all views, where the settings let them share these;
                None: each view has its own.

        Raises:
            Rejected: "unlit_scene" where no emitter has an area (with `per_light`: where one has
                none), "no_surfaces" where all triangles emit (emitters are hidden, so every
                picture would be black), "too_many_lights" where more than MAX_LIGHTS would be
                kept apart.
        """
        self._settings = settings
        self._shows_looks = shows_looks
        self._began_s = 0.0
        self.tracer = load_tracer(scene, max_depth=settings.max_depth, rr_depth=settings.rr_depth)
        if settings.part_names:
            self.tracer = self.tracer.split_lights(
                bounces=settings.split, lobes=settings.split_lobes
            )
        self._tracers = [self.tracer]
        self._arithmetic: Any = ViewPictures
        if settings.arithmetic == "device":
            from pipeline.renders.device_pictures import DevicePictures  # imports mitsuba

            self._arithmetic = DevicePictures
        self._sees_sky = scene.environment is not None and scene.environment.is_seen
        if settings.per_light:
            most = MAX_LIGHTS // max(1, len(settings.part_names))
            lights = light_sources(scene)
            if len(lights) > most:
                raise Rejected("too_many_lights", f"{len(lights)} lights apart; at most {most}")
            self._tracers = [self.tracer.only_light(row) for row in lights]
        self._light_seed = light_seed if settings.light_paths == "scene" else None
        if self._light_seed is not None:
            views = zip(scene.c2w, scene.fov_deg, strict=True)
            cameras = [pixel_camera(*view, settings.resolution) for view in views]
            self._tracers = [tracer.for_views(cameras) for tracer in self._tracers]

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
        return run_to_end(self.view_steps(c2w, fov_deg, seed))

    def view_steps(
        self, c2w: ArrayLike, fov_deg: float, seed: int
    ) -> Iterator[Sampling | RenderedView]:
        """Do what `render_view` does: yield after each pass of one half, and last the picture."""
        settings = self._settings
        camera = pixel_camera(c2w, fov_deg, settings.resolution)
        settled = first_spp(settings)
        if self._shows_looks:
            yield from self._first_looks(camera, seed)
        self._began_s = time.process_time()
        samples = DualBuffer(
            self._tracers,
            camera,
            seed,
            first_spp=settled,
            max_spp=settings.max_spp,
            light_seed=self._light_seed,
        )
        first_pass_of_both = 2 * samples.pass_spp
        for _ in samples.passes_to(first_pass_of_both):
            yield Sampling(spp=samples.spp, expected_spp=settled, missing_db=None)
        mean = self._arithmetic.mean_radiance(samples)
        if mean < (bound := settings.min_mean_radiance):
            raise Rejected("black_view", f"mean radiance {mean:.2g} is below {bound:.2g}")
        for _ in samples.passes_to(settled):
            yield Sampling(spp=samples.spp, expected_spp=settled, missing_db=None)
        pictures: ViewPictures = self._arithmetic(samples, self.tracer, camera, settings)
        if not self._sees_sky:
            samples.counted = pictures.visible
        look = yield from self._render_until_targets(samples, pictures)
        floor = look.floor
        missed = gaps_db(settings.targets_db, by_metric(floor))
        if settings.reject_at_cap and missed:
            raise Rejected(
                "floor_not_reached",
                ", ".join(
                    f"{metric} is {by_metric(floor)[metric]:.1f} dB; expected "
                    f"{settings.targets_db[metric]:g}"
                    for metric in missed
                ),
            )
        stored = self._to_stored(pictures.finish())
        yield RenderedView(
            spp=samples.spp,
            **vars(floor),
            at_cap=bool(missed),
            core_s=time.process_time() - self._began_s,
            hits=pictures.hits,
            part_floors=look.part_floors or None,
            light_floors=look.light_floors or None,
            expected_error=look.expected,
            **stored,
        )

    def _first_looks(self, camera: PixelCamera, seed: int) -> Iterator[Sampling]:
        expected = first_spp(self._settings)
        for spp in FIRST_LOOKS_SPP:
            image = run_to_end(preview_steps(self.tracer, camera, seed, spp, usual_filter(spp)))
            yield Sampling(spp=spp, expected_spp=expected, missing_db=None, image=image)

    def _to_stored(self, pictures: NDArray[np.float32]) -> dict[str, Any]:
        """Return the pictures of a view by their fields: the sum of what is apart, as stored."""
        per_light = self._settings.per_light
        names = self._settings.part_names
        if not (per_light or names):
            return {"radiance_rgb": representable(pictures[0])}
        rounded = rounded_to_half(representable(pictures))  # all parts of one light together
        parts = rounded.reshape(-1, max(1, len(names)), *pictures.shape[1:]).swapaxes(0, 1)
        lights = sum_of_lights(parts)
        named = zip(names, parts if per_light else parts[:, 0], strict=False)
        return {
            "radiance_rgb": representable(sum_of_lights(lights)),
            "lights_rgb": lights if per_light else None,
            "parts_rgb": dict(named) or None,
        }

    def _render_until_targets(
        self, samples: DualBuffer, pictures: ViewPictures
    ) -> Generator[Sampling, None, MeasuredLook]:
        targets_db = self._settings.targets_db
        max_spp = self._settings.max_spp
        measured: list[tuple[int, Floors]] = []
        visible = np.ones_like(pictures.visible) if self._sees_sky else pictures.visible
        tiles = TileChoice(visible)
        while True:
            quality = self._settings.denoiser
            if quality == "high" and samples.spp <= _FAST_HALVES_SPP:
                quality = "fast"
            look = pictures.look(quality)
            tiles.learn(look.changes, samples, quality)
            measured.append((samples.spp, by_metric(look.floor)))
            gaps = gaps_db(targets_db, by_metric(look.floor))
            if not gaps or samples.spp >= max_spp:
                return look
            step = 2 * samples.pass_spp
            expected = expected_spp(measured, targets_db, step=step, max_spp=max_spp)
            missing_db = max(gaps.values())
            if self._shows_looks:
                looked_s = time.process_time()
                radiance_rgb = self._to_stored(pictures.finish())["radiance_rgb"]
                core_s = time.process_time() - self._began_s
                self._began_s += time.process_time() - looked_s  # to be shown takes a view no time
                image = Image(
                    radiance_rgb=radiance_rgb,
                    samples=samples.spp,
                    stated_error_db=look.floor.noise_floor_db,
                    cpu_seconds=core_s,
                    facts={"spp": samples.spp},
                    remark=few_samples_remark(samples.spp),
                )
                yield Sampling(
                    spp=samples.spp, expected_spp=expected, missing_db=missing_db, image=image
                )
            if expected >= _GUIDED_SPP:
                samples.guide()
            spp = next_spp(samples.spp, expected, step)
            chosen = tiles.passes(samples, spp)
            passes = samples.passes_to(spp) if chosen is None else samples.passes_over(chosen)
            for _ in passes:
                yield Sampling(spp=samples.spp, expected_spp=expected, missing_db=missing_db)


def set_threads(count: int) -> None:
    """Let Mitsuba and the denoiser of this process use `count` threads; call after `activate`."""
    import drjit

    drjit.set_thread_count(count)
    set_denoiser_threads(count)
