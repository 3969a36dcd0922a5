"""Our renderer as a side: one view under many settings, each with its price.

Core-seconds are those of the process: sampling, guide pictures, measuring the floor, and the one
denoise that makes the picture. Loading the scene is counted apart; kernels are warm.

The same view rendered to several noise floors is the same passes, more or fewer of them. With a
tracer that remembers, each target takes exactly the path that it would take alone, and is charged
for all that it uses, while the machine traces only what the hardest one needs.
"""

import copy
import dataclasses
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.camera import Camera
from pipeline.renders.denoiser import Quality, denoise
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.results import RenderedView
from pipeline.renders.settings import RenderSettings
from pipeline.renders.tracer import Chosen, Features, Tracer
from storage.metrics import MAX_DB
from storage.records.lights import encode_lights_exr
from storage.records.profiles import pack_picture
from storage.records.scene import Scene

Answer = TypeVar("Answer")


class RememberingTracer:
    """A `Tracer` around another one that traces nothing twice; use a new one for every view."""

    def __init__(self, tracer: Tracer, ledger: "Ledger | None" = None, *, guided: bool = False):
        self._tracer = tracer
        self._guided = guided
        self.ledger = Ledger() if ledger is None else ledger
        """What was traced, shared with the tracer that is guided."""

    def only_light(self, row: int) -> "RememberingTracer":
        return RememberingTracer(self._tracer.only_light(row))

    def apart(self, *, bounces: bool, lobes: bool) -> "RememberingTracer":
        """Raise NotImplementedError: what is remembered are passes of all light together."""
        raise NotImplementedError("passes of all light together are remembered")

    def guided(self) -> "RememberingTracer":
        """Return the guided tracer, where the renderer can be guided; the view pays for learning.

        Both halves ask, and learn once.
        """
        make = getattr(self._tracer, "guided", None)
        if self._guided or make is None:
            return self
        tracer = self.ledger.once(("guided",), make)
        return RememberingTracer(tracer, self.ledger, guided=True)

    def radiance(
        self, camera: Camera, *, seed: int, spp: int, chosen: Chosen = None
    ) -> NDArray[np.float32]:
        pixels = None if chosen is None else chosen.tobytes()
        return self.ledger.remembered(
            ("radiance", self._guided, seed, spp, pixels),
            lambda: self._tracer.radiance(camera, seed=seed, spp=spp, chosen=chosen),
        )

    def pass_sum(self, camera: Camera) -> "RememberingSum":
        return RememberingSum(self, camera)

    def features(self, camera: Camera, *, spp: int) -> Features:
        return self.ledger.remembered(
            ("features", spp), lambda: self._tracer.features(camera, spp=spp)
        )

    def hits(self, camera: Camera) -> NDArray[np.bool_]:
        return self.ledger.remembered(("hits",), lambda: self._tracer.hits(camera))


class RememberingSum:
    """The sum of remembered passes, guided where the renderer asks for it."""

    def __init__(self, tracer: RememberingTracer, camera: Camera) -> None:
        self._tracer, self._camera = tracer, camera
        self._total = np.zeros((camera.resolution, camera.resolution, 3))
        self._squares = np.zeros((camera.resolution, camera.resolution))

    def add(self, *, seed: int, spp: int, chosen: Chosen = None) -> None:
        means = self._tracer.radiance(self._camera, seed=seed, spp=spp, chosen=chosen)
        mean = means.astype(np.float64)
        self._total += spp * mean
        self._squares += spp * np.square(mean.mean(axis=-1))

    def guide(self) -> None:
        self._tracer = self._tracer.guided()

    def read(self) -> NDArray[np.float64]:
        return self._total[None].copy()

    def read_squares(self) -> NDArray[np.float64]:
        return self._squares.copy()


class Ledger:
    """Answers with what they cost, and what a view owes for those that it did not pay itself."""

    def __init__(self) -> None:
        self._answers: dict[tuple[Any, ...], tuple[Any, float]] = {}
        self._paid: set[tuple[Any, ...]] = set()
        self.owed_core_s = 0.0
        """Core-seconds of remembered answers since the view began: what it would have spent besides
        its own."""

    def begin_view(self) -> None:
        """Owe nothing."""
        self.owed_core_s = 0.0
        self._paid.clear()

    def remembered(self, key: tuple[Any, ...], trace: Callable[[], Answer]) -> Answer:
        """Return an answer that the renderer would compute each time that it asks."""
        if key in self._answers:
            answer, core_s = self._answers[key]
            self.owed_core_s += core_s
        else:
            started = time.process_time()
            answer = trace()
            self._answers[key] = (answer, time.process_time() - started)
        return answer

    def once(self, key: tuple[Any, ...], learn: Callable[[], Answer]) -> Answer:
        """Return an answer that the renderer keeps for the view."""
        if key in self._paid:
            answer: Answer = self._answers[key][0]
            return answer
        self._paid.add(key)
        return self.remembered(key, learn)


SEED = 20_261_122
"""Seed of pictures and scenes that are drawn here; no build and no run uses it."""

_SMALL = 32
"""Pixels each way of what only compiles."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """One view under one setting."""

    view: RenderedView
    """The picture with its floor and its samples."""
    core_s: float
    """Core-seconds alone: samples, guide pictures, measuring the floor, the last denoise."""
    load_core_s: float
    """Loading the scene: arrays, tree of triangles, tables of lights."""
    packed_bytes: int
    """Size in the profile `compact`, with the pictures of single lights if there are any."""


def fixed_samples(resolution: int, spp: int) -> RenderSettings:
    """Return settings that no noise floor stops early.

    Args:
        resolution: pixels each way.
        spp: samples per pixel; a multiple of 128 for the best sampling.
    """
    return RenderSettings(
        resolution=resolution,
        noise_floor_db=MAX_DB - 1,
        min_spp=spp,
        max_spp=spp,
        min_mean_radiance=0.0,
    )


def shots(scene: Scene, variants: Mapping[str, RenderSettings]) -> dict[str, Shot]:
    """Return a scene's first view under each setting, with equal seeds; runs in a render child.

    Settings of equal depths and resolution share what is traced, and each is charged for it.
    """
    renderers: dict[tuple[int, ...], tuple[RememberingRenderer, float]] = {}
    found = {}
    for name, settings in variants.items():
        key = (settings.max_depth, settings.rr_depth, settings.resolution)
        if settings.per_light:
            warm_up_kernels(scene, settings)
            found[name] = _alone(scene, settings)
            continue
        if key not in renderers:
            warm_up_kernels(scene, settings)
            started = time.process_time()
            renderer = RememberingRenderer(scene, settings)
            renderers[key] = renderer, time.process_time() - started
        if settings.denoiser != "off":
            warm_up_denoiser(settings.resolution, settings.denoiser)
        renderer, load_core_s = renderers[key]
        view, core_s = renderer.timed_view(SEED, settings)
        found[name] = _shot(view, core_s, load_core_s)
    return found


def warm_up_kernels(scene: Scene, settings: RenderSettings) -> None:
    """Let this process compile the tracer for a scene with a camera: kernels depend on the depths.

    They do not depend on the resolution; the denoiser's memory does (`warm_up_denoiser`).
    """
    small = dataclasses.replace(settings, resolution=_SMALL, max_spp=settings.min_spp)
    SceneRenderer(scene, small).render_view(scene.c2w[0], float(scene.fov_deg[0]), seed=0)


def warm_up_denoiser(resolution: int, quality: Quality = "high") -> None:
    """Let this process make its filter for pictures of a size."""
    black = np.zeros((resolution, resolution, 3), np.float32)
    denoise(black, Features(albedo=black, normal=black), quality)


class RememberingRenderer(SceneRenderer):
    """The product's renderer around a tracer that remembers the passes of its one view."""

    def __init__(self, scene: Scene, settings: RenderSettings) -> None:
        super().__init__(scene, settings)
        self._camera = (scene.c2w[0], float(scene.fov_deg[0]))
        self._remembering = RememberingTracer(self._tracer)
        self._tracer, self._tracers = self._remembering, [self._remembering]

    def timed_view(self, seed: int, settings: RenderSettings) -> tuple[RenderedView, float]:
        """Return the first view under other settings, and the core-seconds it would take alone.

        Args:
            seed: of the view.
            settings: with the depths that the tracer was made with, and lights together.
        """
        other = copy.copy(self)
        other._settings = settings
        self._remembering.ledger.begin_view()
        started = time.process_time()
        view = other.render_view(*self._camera, seed)
        return view, time.process_time() - started + self._remembering.ledger.owed_core_s


def _alone(scene: Scene, settings: RenderSettings) -> Shot:
    started = time.process_time()
    renderer = SceneRenderer(scene, settings)
    loaded = time.process_time()
    view = renderer.render_view(scene.c2w[0], float(scene.fov_deg[0]), SEED)
    return _shot(view, time.process_time() - loaded, loaded - started)


def _shot(view: RenderedView, core_s: float, load_core_s: float) -> Shot:
    if view.lights_rgb is None:
        packed = len(pack_picture(view.radiance_rgb, view.noise_floor_db, "compact"))
    else:  # as storage.records.sample packs them: pictures stay the exact sum of their lights
        packed = len(pack_picture(view.radiance_rgb, view.noise_floor_db, "lossless"))
        packed += len(encode_lights_exr(view.lights_rgb))
    return Shot(view=view, core_s=core_s, load_core_s=load_core_s, packed_bytes=packed)
