"""What a render child does for one view: our picture at one noise floor after the other.

Core-seconds are those of the process: sampling, guide pictures, measuring the floor, and the one
denoise that makes the picture. Loading the scene is counted apart; kernels are warm.
"""

import copy
import dataclasses
import time
from dataclasses import dataclass

import numpy as np

from infra.bench.renders.remembering_tracer import RememberingTracer
from pipeline.flows.training_builds import pretrain_256
from pipeline.renders.denoiser import Quality, denoise
from pipeline.renders.renderer import RenderedView, SceneRenderer
from pipeline.renders.settings import RenderSettings
from pipeline.renders.tracer import Features
from storage.scene import Scene

_SMALL = 32
"""Pixels each way of what only compiles."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Rung:
    """One view, rendered until its floor reached a target or its samples the cap."""

    target_db: float
    """Of the noise floor, psnr_log_db."""
    view: RenderedView
    """The picture with its floor and its samples."""
    core_s: float
    """What this target would have taken alone."""

    @property
    def reached(self) -> bool:
        """Whether the floor is at the target."""
        return not self.view.at_cap


@dataclass(frozen=True, kw_only=True, eq=False)
class Ladder:
    """One view at every target."""

    load_core_s: float
    """Core-seconds of loading the scene: arrays, tree of triangles, tables of lights."""
    rungs: tuple[Rung, ...]
    """In the order of the targets."""


def render_ladder(
    scene: Scene, resolution: int, targets_db: tuple[float, ...], max_spp: int, seed: int
) -> Ladder:
    """Render a scene's first view to each target; every pass is traced once.

    Args:
        scene: that passes `Scene.check`.
        resolution: pixels each way.
        targets_db: noise floors.
        max_spp: the cap; all else is as in `pretrain-256`.
        seed: of the view.
    """
    settings = dataclasses.replace(
        pretrain_256().renders,
        resolution=resolution,
        noise_floor_db=max(targets_db),
        max_spp=max_spp,
        min_mean_radiance=0.0,
    )
    warm_up_kernels(scene, settings)
    warm_up_denoiser(resolution)
    started = time.process_time()
    remembering = RememberingRenderer(scene, settings)
    load_core_s = time.process_time() - started
    rungs = []
    for target_db in targets_db:
        view, core_s = remembering.timed_view(
            seed, dataclasses.replace(settings, noise_floor_db=target_db)
        )
        rungs.append(Rung(target_db=target_db, view=view, core_s=core_s))
    return Ladder(load_core_s=load_core_s, rungs=tuple(rungs))


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
        self._tracer, self._parts = self._remembering, [self._remembering]

    def timed_view(self, seed: int, settings: RenderSettings) -> tuple[RenderedView, float]:
        """Return the first view under other settings, and the core-seconds it would take alone.

        Args:
            seed: of the view.
            settings: with the depths that the tracer was made with, and lights together.
        """
        other = copy.copy(self)
        other._settings = settings
        self._remembering.owed_core_s = 0.0
        started = time.process_time()
        view = other.render_view(*self._camera, seed)
        return view, time.process_time() - started + self._remembering.owed_core_s
