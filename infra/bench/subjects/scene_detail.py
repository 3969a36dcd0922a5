"""What coarser objects cost in the picture: the same scenes with levels of a stated error.

Places, materials, lights, camera and random numbers stay; only the meshes change. The difference to
the finest meshes is compared with that of the finest ones to themselves with other random numbers.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.builds.training import pretrain_256, smoke
from pipeline.making.make_scene import assets_of
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.settings import RenderSettings
from pipeline.scenes.budget import drawn_within, least_triangles, levels_within
from pipeline.scenes.compose import scene_pieces
from pipeline.scenes.pieces import joined
from pipeline.scenes.pool import PooledAsset
from pipeline.scenes.shapes import MeshShape
from pipeline.scenes.views import with_first_cameras
from scene_templates.layout_rand import layout_rand, scene_plan
from scene_templates.settings import SceneSettings
from storage.metrics import psnr_log_db
from storage.records.scene import Scene
from storage.seeds import rng_for

ERRORS = (0.03, 0.02, 0.01, 0.005, 0.0025)
_SPP = 256
_NO_LIMIT = 10**9


def picture_errors(
    scene_index: int, resolution: int = 256, spp: int = _SPP
) -> Mapping[str, tuple[float, float]]:
    """Return (triangles of objects, psnr_log_db to the finest) by stated error, in a render child.

    "finest" holds the comparison of the finest with itself under another seed.

    Args:
        scene_index: which scene of the build `smoke`.
        resolution: pixels across its first view.
        spp: samples per pixel.
    """
    renders = dataclasses.replace(
        smoke().renders, resolution=resolution, min_spp=spp, max_spp=spp, min_mean_radiance=0.0
    )
    settings = dataclasses.replace(smoke().scenes, num_views=1)
    pool = assets_of("train")
    finest = _scene(settings, pool, scene_index, 0.0)
    with_camera = with_first_cameras(finest, settings)
    camera = (with_camera.c2w, with_camera.fov_deg)
    reference = _picture(finest.with_cameras(*camera), renders, seed=0)
    other = _picture(finest.with_cameras(*camera), renders, seed=1)
    found = {"finest": (float(_object_triangles(finest)), psnr_log_db(reference, other))}
    for error in ERRORS:
        scene = _scene(settings, pool, scene_index, error)
        picture = _picture(scene.with_cameras(*camera), renders, seed=0)
        db = psnr_log_db(reference, picture)
        found[f"{error:.2%}"] = (float(_object_triangles(scene)), db)
    return found


def _scene(
    settings: SceneSettings, pool: Sequence[PooledAsset], scene_index: int, error: float
) -> Scene:
    """Return a scene whose layout is that of the finest meshes, with meshes of another error."""
    plan = scene_plan(settings, seed=0, scene_index=scene_index)
    rng = rng_for(0, "bench-scene", scene_index)
    least = [least_triangles(entry.asset) for entry in pool]
    chosen = drawn_within(rng, pool, least, plan.num_objects, _NO_LIMIT)
    assets = [entry.asset for entry in chosen]
    finest, wanted = (
        [
            MeshShape(entry.locked.uid, level, settings.centring)
            for entry, level in zip(chosen, levels_within(assets, _NO_LIMIT, enough), strict=True)
        ]
        for enough in (0.0, error)
    )
    layout = layout_rand(rng, settings, plan, finest)
    pieces = scene_pieces(layout, chosen, wanted, settings, rng)
    return Scene(
        **joined(pieces),
        c2w=np.zeros((0, 4, 4), np.float32),
        fov_deg=np.zeros(0, np.float32),
        objects=tuple(piece.entry for piece in pieces),
        provenance={
            "template": plan.family.template,
            "scene_index": scene_index,
            "attempt": 0,
            "seed": 0,
            "camera_attempts": [],
        },
    )


def _picture(scene: Scene, renders: RenderSettings, *, seed: int) -> NDArray[np.float32]:
    view = SceneRenderer(scene, renders).render_view(scene.c2w[0], float(scene.fov_deg[0]), seed)
    return view.radiance_rgb


def _object_triangles(scene: Scene) -> int:
    kinds = np.array([entry.kind for entry in scene.objects])[scene.object_index]
    return int((kinds == "object").sum())


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fit:
    """One scene within a budget."""

    triangles: int
    """Triangles of the whole scene."""
    errors: tuple[float, ...]
    """Of each object: two-way distance, 99th percentile, as a share of the diagonal."""


def scene_fits(budgets: tuple[int, ...], scene_index: int) -> tuple[Fit, ...]:
    """Return what becomes of the objects of a scene within each budget; in a render child.

    Objects are drawn once, as for the largest budget. Without the hardest scenes, or with simpler
    objects, a small budget would look better, so a scene counts for all budgets or for none.

    Raises:
        Rejected: some budget cannot hold the scene.
    """
    settings, pool = pretrain_256().scenes, assets_of("train")
    least = [least_triangles(entry.asset) for entry in pool]
    plan = scene_plan(settings, seed=0, scene_index=scene_index)
    taken = plan.family.shell_triangles + plan.num_lights
    rng = rng_for(0, "trade-budget", scene_index)
    chosen = drawn_within(rng, pool, least, plan.num_objects, max(budgets) - taken)
    assets = [one.asset for one in chosen]
    found = []
    for budget in budgets:
        levels = levels_within(assets, budget - taken, settings.enough_error)
        errors = tuple(level.record.quality.error_p99 for level in levels)
        triangles = taken + sum(len(level.faces) for level in levels)
        found.append(Fit(triangles=triangles, errors=errors))
    return tuple(found)
