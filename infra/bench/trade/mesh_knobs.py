"""What geometry costs: triangles of an object and of a scene, against error, picture, network."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from infra.bench import remeshing
from infra.bench.assets import CURVE, medians_side
from infra.bench.mesh_pictures import coarser, picture_db
from infra.bench.renders.fixed_samples import fixed_samples
from infra.bench.trade.curves import Curve, Knob, Point
from infra.bench.trade.workshop import LARGE, Workshop
from pipeline.assets.settings import AssetSettings
from pipeline.flows.make_scene import assets_of
from pipeline.flows.training_builds import pretrain_256
from pipeline.isolation import ChildFailed
from storage.asset import Asset
from storage.errors import Rejected, TrilightError
from storage.seeds import rng_for

OBJECTS = 2
"""In the scene that the budget of one object is priced in."""
PICTURED = 3
"""Objects that are path traced at every budget: some seconds each."""
PROFILE_BUDGET = 512
EPSILONS = (None, 0.02, 0.01, 0.005, 0.0025)
SCENE_BUDGETS = (768, 1024, 1536, 2048, 4096)


def _remeshed(shop: Workshop, sides: Mapping[str, tuple[str, int]]) -> dict[str, dict[str, float]]:
    """Return medians over objects by setting; an object that one side fails on counts for none."""
    paths = list(shop.sources)
    runs = {
        name: medians_side(shop.mesh_child, paths, method, budget)
        for name, (method, budget) in sides.items()
    }
    return shop.in_turns("trade-meshes", runs)


def _picture_errors(shop: Workshop) -> NDArray[np.float64]:
    """Return psnr_log_db to the source [objects, budgets and the source again] of a few objects.

    An object that fails counts for none; there may be no row.
    """
    px, spp, rows = shop.effort.picture_px, shop.effort.fixed_spp, []
    for path in shop.sources[:PICTURED]:
        with contextlib.suppress(Rejected, ChildFailed):
            meshes = shop.mesh_child.call(coarser, path, CURVE, remeshing.METHODS["faithful"])
            rows.append(shop.call(picture_db, meshes, fixed_samples(px, spp)))
    return np.array(rows).reshape(-1, len(CURVE) + 1)


def measure_budget(shop: Workshop) -> Curve:
    """Measure error of geometry and picture at budgets of one object, and the network's time."""
    found = _remeshed(shop, {f"{budget}": ("faithful", budget) for budget in CURVE})
    pictures = _picture_errors(shop)
    if not len(pictures):
        count = min(PICTURED, len(shop.sources))
        raise TrilightError(f"knob budget: none of {count} objects could be rendered.")
    median_db = np.median(pictures, axis=0)
    room = pretrain_256().scenes.max_triangles
    default = max(budget for budget in CURVE if OBJECTS * budget <= room)
    points = [
        Point(
            setting=f"{budget} triangles",
            cost=shop.network_core_s(OBJECTS * found[f"{budget}"]["faces"]),
            error=100 * found[f"{budget}"]["error_p99"],
            default=budget == default,
            further={
                "mean error %": 100 * found[f"{budget}"]["error_mean"],
                "picture, psnr_log_db": float(median_db[column]),
                "making it, core-ms": 1000 * found[f"{budget}"]["cpu_s"],
            },
        )
        for column, budget in enumerate(CURVE)
    ]
    effort = shop.effort
    words = f"{len(shop.sources)} objects, {OBJECTS} in a scene; the network is {effort.network}"
    return Curve(
        points=tuple(points),
        measured_on=f"{words}, {effort.network_px} pixels. The picture: path traced beside the "
        f"cleaned source, median of the {len(pictures)} largest objects, each alone on a floor "
        f"under a lamp, {effort.picture_px} x {effort.picture_px}, {effort.fixed_spp} samples; the "
        f"source with other samples has {median_db[-1]:.1f} dB",
    )


def measure_profile(shop: Workshop) -> Curve:
    """Measure the methods of decimation at one budget."""
    sides = {method: (method, PROFILE_BUDGET) for method in remeshing.METHODS}
    found = _remeshed(shop, sides)
    points = [
        Point(
            setting=method,
            cost=figures["cpu_s"],
            error=100 * figures["error_p99"],
            default=method == AssetSettings.profile,
            further={"smallest angles, degrees": figures["min_angle_p5_deg"]},
        )
        for method, figures in found.items()
    ]
    return Curve(
        points=tuple(points), measured_on=f"{len(shop.sources)} objects, {PROFILE_BUDGET} faces"
    )


def prepared(path: Path, epsilon: float | None) -> tuple[float, float, float]:
    """Return triangles, 99th percentile of the distance, and core-seconds; in a mesh child."""
    import time

    from pipeline.assets.prepare import prepare_asset

    settings = AssetSettings(budgets=(AssetSettings.budgets[0],), epsilon=epsilon)
    started = time.process_time()
    levels = prepare_asset(path, settings, remeshing.METHODS["faithful"]).asset.levels
    if not levels:
        raise Rejected("no_level", "no level passed the gate")
    finest = levels[0]
    core_s = time.process_time() - started
    return float(len(finest.faces)), finest.record.quality.error_p99, core_s


def measure_epsilon(shop: Workshop) -> Curve:
    """Measure an error bound in place of a budget; an object that fails counts for none."""
    rows = []
    for path in shop.sources:
        with contextlib.suppress(Rejected, ChildFailed):
            rows.append([shop.mesh_child.call(prepared, path, epsilon) for epsilon in EPSILONS])
    if not rows:
        raise TrilightError(f"knob epsilon: none of {len(shop.sources)} objects could be prepared.")
    triangles, errors, core_s = np.moveaxis(np.array(rows), -1, 0)  # each [objects, bounds]
    points = [
        Point(
            setting="none" if epsilon is None else f"{100 * epsilon:g} %",
            cost=float(triangles[:, column].mean()),
            error=100 * float(np.median(errors[:, column])),
            default=epsilon == AssetSettings.epsilon,
            further={
                "largest error %": 100 * float(errors[:, column].max()),
                "making it, core-s": float(core_s[:, column].mean()),
            },
        )
        for column, epsilon in enumerate(EPSILONS)
    ]
    words = f"{len(rows)} objects of {LARGE} faces or more"
    return Curve(
        points=tuple(points), measured_on=f"{words}, at most {AssetSettings.budgets[0]} kept"
    )


@dataclass(frozen=True, kw_only=True)
class Fit:
    """One scene within a budget."""

    triangles: int
    """Of the whole scene."""
    errors: tuple[float, ...]
    """Of each object: two-way distance, 99th percentile, as a share of the diagonal."""


def scene_fits(budgets: tuple[int, ...], count: int) -> list[tuple[Fit, ...]]:
    """Return what becomes of the objects of scenes within each budget; in a render child.

    Objects are drawn once, as for the largest budget, and a scene that some budget cannot hold is
    left out: without its hardest scenes, or with simpler objects, a small one would look better.
    """
    from pipeline.scenes.budget import drawn_within, least_triangles
    from scene_templates.plans import scene_plan

    settings, pool = pretrain_256().scenes, assets_of("train")
    least = [least_triangles(entry.asset) for entry in pool]
    found = []
    for index in range(count):
        plan = scene_plan(settings, seed=0, scene_index=index)
        taken = plan.family.shell_triangles + plan.num_lights
        rng = rng_for(0, "trade-budget", index)
        with contextlib.suppress(Rejected):
            chosen = drawn_within(rng, pool, least, plan.num_objects, max(budgets) - taken)
            assets = [one.asset for one in chosen]
            fits = [_fit(assets, taken, budget, settings.enough_error) for budget in budgets]
            found.append(tuple(fits))
    return found


def _fit(assets: Sequence[Asset], taken: int, budget: int, enough_error: float) -> Fit:
    from pipeline.scenes.budget import levels_within

    levels = levels_within(assets, budget - taken, enough_error)
    return Fit(
        triangles=taken + sum(len(level.faces) for level in levels),
        errors=tuple(level.record.quality.error_p99 for level in levels),
    )


def measure_scene_budget(shop: Workshop) -> Curve:
    """Measure what objects lose to the budget of a scene, in the scenes that fit into every one."""
    effort, count = shop.effort, shop.effort.composed
    scenes: list[tuple[Fit, ...]] = shop.call(scene_fits, SCENE_BUDGETS, count)
    if not scenes:
        raise TrilightError(f"knob scene-budget: none of {count} scenes fits into every budget.")
    default, points = pretrain_256().scenes.max_triangles, []
    for budget, fits in zip(SCENE_BUDGETS, zip(*scenes, strict=True), strict=True):
        errors = [error for fit in fits for error in fit.errors]
        triangles = float(np.mean([fit.triangles for fit in fits]))
        points.append(
            Point(
                setting=f"{budget} triangles",
                cost=shop.network_core_s(triangles),
                error=100 * float(np.percentile(errors, 95)),
                default=budget == default,
                further={"median error %": 100 * float(np.median(errors)), "triangles": triangles},
            )
        )
    words = f"the objects of {len(scenes)} of {count} scenes, the same in every row"
    dropped = f"{count - len(scenes)} that some budget cannot hold are dropped"
    network = f"the network is {effort.network}, {effort.network_px} pixels"
    return Curve(points=tuple(points), measured_on=f"{words}; {dropped}; {network}")


_DISTANCE = "two-way distance to the source, 99th percentile, % of the diagonal"
_NETWORK = "core-seconds of the network for a scene and one view"

KNOBS = (
    Knob(
        name="budget",
        title="Triangles of an object",
        covers=("build.assets.budgets",),
        cost=_NETWORK,
        error=_DISTANCE,
        better="lower",
        against="the cleaned source; median over the objects",
        because="six levels are kept of every object, so the budget is not chosen once: each scene "
        "takes the finest levels that it can hold, and the table marks the finest of which a scene "
        f"of 1536 triangles holds {OBJECTS}. Making them costs milliseconds; what triangles cost "
        "is the network's time, at every visit.",
        measure=measure_budget,
        needs=("torch",),
    ),
    Knob(
        name="profile",
        title="How objects are made coarser",
        covers=("build.assets.profile",),
        cost="core-seconds an object",
        error=_DISTANCE,
        better="lower",
        against="the cleaned source; median over the objects",
        because="`faithful`: the least error for the triangles, which every visit pays. `uniform` "
        "is for who needs even triangles, at more error and more time.",
        measure=measure_profile,
    ),
    Knob(
        name="epsilon",
        title="An error bound in place of a budget",
        covers=("build.assets.epsilon",),
        cost="triangles an object",
        error=_DISTANCE,
        better="lower",
        against="the cleaned source; median over the objects",
        because="none in the builds: scenes choose among six levels by their own budget already. "
        "`trilight assets --epsilon` is for meshes that go elsewhere.",
        measure=measure_epsilon,
    ),
    Knob(
        name="scene-budget",
        title="Triangles of a scene",
        covers=("build.scenes.max_triangles", "build.scenes.fill_to", "train.most_triangles"),
        cost=_NETWORK,
        error=_DISTANCE.replace("99th percentile", "99th percentile, of the worst object in 20"),
        better="lower",
        against="the cleaned sources of the scenes' objects",
        because="1536 in the first stage as published, 4096 in the second: attention grows with "
        "the square, and the worst objects decide what a budget loses. Scenes are not filled "
        "up (`fill_to`): triangles that change no surface cost the network the same.",
        measure=measure_scene_budget,
        needs=("torch",),
    ),
)
