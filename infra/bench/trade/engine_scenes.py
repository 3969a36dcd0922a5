"""Scenes that no network of ours was trained on: objects of the validation split, another seed."""

import dataclasses
from dataclasses import dataclass

from pipeline.flows.make_scene import MAX_ATTEMPTS, assets_of
from pipeline.flows.settings import BuildSettings
from pipeline.flows.training_builds import smoke
from pipeline.renders.renderer import RenderedView, SceneRenderer
from pipeline.renders.settings import RenderSettings
from pipeline.scenes.compose import compose_scene
from storage.changes import changed
from storage.errors import Rejected
from storage.scene import Scene

_SCENE_SEED = 20_261_122
"""No build and no run has it."""
_REFERENCE_SEED = 1_000_003
_LEAST_LEVEL = 24


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldOut:
    """One scene with its reference."""

    scene: Scene
    """With one camera."""
    reference: RenderedView
    """Of its view."""


def build_within(max_triangles: int | None) -> BuildSettings:
    """Return `smoke` for scenes of at most so many triangles, its objects as much coarser."""
    build = smoke()
    most = build.scenes.max_triangles
    if max_triangles is None or max_triangles >= most:
        return build
    budgets = [max(_LEAST_LEVEL, b * max_triangles // most) for b in build.assets.budgets]
    levels = sorted(set(budgets), reverse=True)
    return changed(build, {"scenes.max_triangles": max_triangles, "assets.budgets": levels})


def held_out(build: BuildSettings, index: int, resolution: int, max_spp: int) -> HeldOut | None:
    """Return a scene with its reference, or None where every attempt is rejected.

    Runs in a render child of the build.
    """
    settings = dataclasses.replace(build.scenes, num_views=1)
    pool = assets_of("validation")
    renders = RenderSettings(
        resolution=resolution,
        noise_floor_db=50.0,
        min_spp=min(256, max_spp),
        max_spp=max_spp,
        min_mean_radiance=0.0,
    )
    for attempt in range(MAX_ATTEMPTS):
        try:
            scene = compose_scene(
                settings, pool, seed=_SCENE_SEED, scene_index=index, attempt=attempt
            )
        except Rejected:
            continue
        renderer = SceneRenderer(scene, renders)
        view = renderer.render_view(scene.c2w[0], float(scene.fov_deg[0]), _REFERENCE_SEED)
        return HeldOut(scene=scene, reference=view)
    return None
