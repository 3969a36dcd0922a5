"""Scenes that no network learnt from: objects of the set that networks are judged on, another seed.

`builtin:benchmark-v1` has no object in common with any other source, and no build to train on draws
from it, so this holds for every network that was trained on other objects, with whatever shares
its sets held out: the one that is shipped, the named builds and the published checkpoints alike.
"""

import contextlib
import dataclasses
from dataclasses import dataclass

from infra.bench.sides.shots import SEED
from pipeline.builds.settings import BuildSettings
from pipeline.builds.training import smoke
from pipeline.making.make_scene import MAX_ATTEMPTS, assets_of
from pipeline.renders.renderer import RenderedView, SceneRenderer
from pipeline.renders.settings import RenderSettings
from pipeline.scenes.compose import compose_scene
from storage.dataset.splits import JUDGED_SPLIT
from storage.errors import Rejected
from storage.records.scene import Scene
from storage.settings.changes import changed

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
    """Return `smoke` for scenes of at most so many triangles, its objects as much coarser.

    All of its objects are to judge by, as those of `builtin:benchmark-v1` are.
    """
    build = changed(smoke(), {"splits.one_split": True})
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
    pool = assets_of(JUDGED_SPLIT)
    renders = RenderSettings(
        resolution=resolution,
        noise_floor_db=50.0,
        min_spp=min(256, max_spp),
        max_spp=max_spp,
        min_mean_radiance=0.0,
    )
    for attempt in range(MAX_ATTEMPTS):
        with contextlib.suppress(Rejected):
            scene = compose_scene(settings, pool, seed=SEED, scene_index=index, attempt=attempt)
            renderer = SceneRenderer(scene, renders)
            view = renderer.render_view(scene.c2w[0], float(scene.fov_deg[0]), _REFERENCE_SEED)
            return HeldOut(scene=scene, reference=view)
    return None
