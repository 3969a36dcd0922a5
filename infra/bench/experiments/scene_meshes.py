"""Triangles of a scene, against the error of its objects and of its picture.

Pictures: the same scenes with levels of a stated error. Places, materials, lights, camera and
random numbers stay; only the meshes change. The difference to the finest meshes is compared with
that of the finest ones to themselves with other random numbers.
"""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Point, TurnFigures, percent
from infra.bench.experiments.meshes import NETWORK
from infra.bench.experiments.sampling import DB, WORST
from infra.bench.workshop import Workshop
from pipeline.builds.training import pretrain_256, smoke
from pipeline.making.attempt_scene import assets_of
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
from storage.errors import Rejected
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
    """Error of each object: two-way distance, 99th percentile, as a share of the diagonal."""


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


SCENE_BUDGETS = (768, 1024, 1536, 2048, 4096)
FINEST = "finest, other samples"


def _measure_fits(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    """Measure what the objects of composed scenes lose to each budget, the same in every one."""
    scenes: list[tuple[Fit, ...]] = []
    for index in range(workshop.effort.composed):
        with contextlib.suppress(Rejected):
            scenes.append(workshop.call(scene_fits, SCENE_BUDGETS, index))
    if not scenes:
        raise Rejected("no_scene", "no scene fits into every budget")
    workshop.note(f"{len(scenes)} of {workshop.effort.composed} scenes fit into every budget")
    for point, fits in zip(points, zip(*scenes, strict=True), strict=True):
        errors = [error for fit in fits for error in fit.errors]
        triangles = float(np.mean([fit.triangles for fit in fits]))
        yield (
            point.name,
            {
                "network_s": workshop.network_core_s(triangles),
                "worst": float(np.percentile(errors, 95)),
                "middle": float(np.median(errors)),
                "triangles": triangles,
            },
        )


def _measure_detail(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    effort = workshop.effort
    index = int(turn.split()[-1])
    found = workshop.call(picture_errors, index, effort.picture_px, effort.fixed_spp)
    for point in points:
        triangles, db = found[point.settings]
        cost = workshop.network_core_s(triangles)
        yield point.name, {"network_s": cost, "db": db, "triangles": triangles}


def _details(effort: Effort) -> list[Point]:
    enough = pretrain_256().scenes.enough_error
    levels = [
        Point(name=f"{100 * error:g} %", settings=f"{error:.2%}", default=error == enough)
        for error in ERRORS
    ]
    return [*levels, Point(name=FINEST, settings="finest", judged=False)]


EXPERIMENTS = (
    Experiment(
        name="scene-budget",
        title="Triangles of a scene",
        about="The objects of composed scenes, the same in every row, within each budget; scenes "
        "that some budget cannot hold are left out.",
        covers=("build.scenes.max_triangles", "build.scenes.fill_to", "train.most_triangles"),
        cost=NETWORK,
        error=Column(
            name="two-way distance to the source, 99th percentile, of the worst object in 20, % of "
            "the diagonal",
            figure="worst",
            then=percent,
        ),
        against="the cleaned sources of the scenes' objects",
        columns=(
            Column(name="median error %", figure="middle", then=percent),
            Column(name="triangles", figure="triangles"),
        ),
        because=(
            "Default: 1536 in the first stage as published, 4096 in the second. The cost of "
            "attention grows with the square of the triangles, and the worst objects decide "
            "what a budget loses. Scenes are not filled up (`fill_to`): triangles that change "
            "no surface cost the network the same."
        ),
        points=lambda effort: [
            Point(
                name=f"{budget} triangles",
                settings=budget,
                default=budget == pretrain_256().scenes.max_triangles,
            )
            for budget in SCENE_BUDGETS
        ],
        turns=lambda effort: ["all scenes"],
        measure=_measure_fits,
        needs=("torch",),
    ),
    Experiment(
        name="detail",
        title="Distance to the source that is near enough",
        about="Pictures of the same scenes of `smoke` with coarser objects: same places, "
        "materials, lights, camera and random numbers.",
        covers=("build.scenes.enough_error",),
        cost=NETWORK,
        error=DB,
        better="higher",
        against=(
            "the path traced picture of the finest meshes (at most 1400 triangles each); "
            "median over the scenes. The last row is that picture itself with other samples: "
            "no better agreement can be measured"
        ),
        columns=(
            WORST,
            Column(name="object triangles", figure="triangles", over="mean"),
        ),
        because=(
            "Default: 0.5 % at 256 pixels, 0.25 % at 512. Facets and outlines move highlights "
            "long before a distance becomes visible; but every picture of a set is of the very "
            "triangles that the network is given, so this is no error of the labels."
        ),
        points=_details,
        turns=lambda effort: [f"smoke {index}" for index in range(max(2, effort.scenes // 2))],
        measure=_measure_detail,
        needs=("torch",),
    ),
)
