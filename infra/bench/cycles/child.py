"""What a comparison runs in a render child: making scenes, and rendering them with our renderer."""

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from infra.bench.renders.fixed_samples import fixed_samples
from pipeline.assets.settings import AssetSettings
from pipeline.flows.make_scene import MAX_ATTEMPTS, assets_of
from pipeline.flows.scene_files import build_scene
from pipeline.flows.training_builds import smoke
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.settings import PASS_SPP
from pipeline.scenes.compose import compose_scene
from storage.errors import Rejected, TrilightError
from storage.scene import Scene

_WARM_UP_SPP = 2 * PASS_SPP[0]


@dataclass(frozen=True, kw_only=True, eq=False)
class OurPicture:
    """One finished picture and what it took."""

    radiance_rgb: NDArray[np.float32]
    """[R, R, 3] linear radiance."""
    render_s: float
    """On the clock: samples, guide pictures, and three runs of the denoiser, two of which only
    measure the noise floor. Reading the scene, building its tree and compiling came before."""
    core_s: float
    """Core-seconds of the same."""


def sampled_scene(scene_index: int) -> Scene:
    """Return a scene of the build `smoke` with one camera, as a run would compose it."""
    settings = dataclasses.replace(smoke().scenes, num_views=1)
    for attempt in range(MAX_ATTEMPTS):
        try:
            return compose_scene(
                settings, assets_of("train"), seed=0, scene_index=scene_index, attempt=attempt
            )
        except Rejected:
            continue
    raise TrilightError(f"scene {scene_index}: rejected {MAX_ATTEMPTS} times; choose others.")


def described_scene(root: Path, name: str) -> Scene:
    """Return the scene of a RenderFormer file with its first camera."""
    scene, _ = build_scene(
        root,
        name,
        AssetSettings(),
        licence="LicenseRef-user-provided",
        num_views=1,
        scene_index=0,
        seed=0,
    )
    return scene


def our_picture(scene: Scene, view: int, resolution: int, spp: int, seed: int) -> OurPicture:
    """Render one view with a fixed number of samples, the denoiser at its best.

    Kernels are compiled by a picture that does not count.
    """
    camera = (scene.c2w[view], float(scene.fov_deg[view]))
    warm_up = SceneRenderer(scene, fixed_samples(resolution, _WARM_UP_SPP))
    warm_up.render_view(*camera, seed)
    renderer = SceneRenderer(scene, fixed_samples(resolution, spp))
    wall, core = time.perf_counter(), time.process_time()
    rendered = renderer.render_view(*camera, seed)
    return OurPicture(
        radiance_rgb=rendered.radiance_rgb,
        render_s=time.perf_counter() - wall,
        core_s=time.process_time() - core,
    )
