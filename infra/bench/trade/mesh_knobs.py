"""What geometry costs: triangles of an object and of a scene, against error, picture, network."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from infra.bench import remeshing
from infra.bench.trade.curves import Curve, Knob, Point
from infra.bench.trade.workshop import LARGE, Workshop
from pipeline.assets.settings import AssetSettings
from pipeline.flows.make_scene import assets_of
from pipeline.flows.training_builds import pretrain_256
from storage.errors import Rejected
from storage.seeds import rng_for

BUDGETS = (64, 128, 256, 512, 1024)
PROFILE_BUDGET = 512
EPSILONS = (None, 0.02, 0.01, 0.005, 0.0025)
SCENE_BUDGETS = (768, 1024, 1536, 2048, 4096)


def _remeshed(shop: Workshop, sides: Mapping[str, tuple[str, int]]) -> dict[str, dict[str, float]]:
    """Return medians over objects by setting; an object that one side fails on counts for none."""
    from infra.bench.assets import medians_side

    paths = list(shop.sources)
    runs = {
        name: medians_side(shop.mesh_child, paths, method, budget)
        for name, (method, budget) in sides.items()
    }
    return shop.in_turns("trade-meshes", runs)


def measure_budget(shop: Workshop) -> Curve:
    """Measure geometric error at budgets of one object, and the network's time for a scene."""
    found = _remeshed(shop, {f"{budget}": ("faithful", budget) for budget in BUDGETS})
    points = [
        Point(
            setting=f"{budget} triangles",
            # four objects in a room, as the larger half of the scenes
            cost=shop.network_core_s(4 * found[f"{budget}"]["faces"]),
            error=100 * found[f"{budget}"]["error_p99"],
            default=budget == BUDGETS[-1],
            further={
                "mean error %": 100 * found[f"{budget}"]["error_mean"],
                "making it, core-ms": 1000 * found[f"{budget}"]["cpu_s"],
            },
        )
        for budget in BUDGETS
    ]
    words = f"{len(shop.sources)} objects, four in a scene; the network is {shop.effort.network}"
    return Curve(points=tuple(points), measured_on=f"{words}, {shop.effort.network_px} pixels")


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
    """Measure an error bound in place of a budget."""
    found = []
    for epsilon in EPSILONS:
        rows = np.array([shop.mesh_child.call(prepared, path, epsilon) for path in shop.sources])
        found.append(
            Point(
                setting="none" if epsilon is None else f"{100 * epsilon:g} %",
                cost=float(rows[:, 0].mean()),
                error=100 * float(np.median(rows[:, 1])),
                default=epsilon is AssetSettings.epsilon,
                further={
                    "largest error %": 100 * float(rows[:, 1].max()),
                    "making it, core-s": float(rows[:, 2].mean()),
                },
            )
        )
    words = f"{len(shop.sources)} objects of {LARGE} faces or more"
    return Curve(
        points=tuple(found), measured_on=f"{words}, at most {AssetSettings.budgets[0]} kept"
    )


def budget_errors(max_triangles: int, count: int) -> tuple[float, float, float]:
    """Return triangles of objects (mean), errors (median, 95th percentile); in a render child."""
    from pipeline.scenes.budget import drawn_within, least_triangles, levels_within
    from scene_templates.plans import scene_plan

    settings = dataclasses.replace(pretrain_256().scenes, max_triangles=max_triangles)
    pool, errors, triangles = assets_of("train"), list[float](), list[int]()
    least = [least_triangles(entry.asset) for entry in pool]
    for index in range(count):
        plan = scene_plan(settings, seed=0, scene_index=index)
        room = max_triangles - plan.family.shell_triangles - plan.num_lights
        rng = rng_for(0, "trade-budget", index)
        with contextlib.suppress(Rejected):
            chosen = drawn_within(rng, pool, least, plan.num_objects, room)
            levels = levels_within([one.asset for one in chosen], room, settings.enough_error)
            errors += [level.record.quality.error_p99 for level in levels]
            triangles.append(max_triangles - room + sum(len(level.faces) for level in levels))
    return float(np.mean(triangles)), float(np.median(errors)), float(np.percentile(errors, 95))


def measure_scene_budget(shop: Workshop) -> Curve:
    """Measure what the objects of scenes lose to the budget of a whole scene."""
    count = shop.effort.composed
    rows: Sequence[tuple[float, float, float]] = [
        shop.call(budget_errors, budget, count) for budget in SCENE_BUDGETS
    ]
    default = pretrain_256().scenes.max_triangles
    points = [
        Point(
            setting=f"{budget} triangles",
            cost=shop.network_core_s(triangles),
            error=100 * high,
            default=budget == default,
            further={"median error %": 100 * median, "triangles": triangles},
        )
        for budget, (triangles, median, high) in zip(SCENE_BUDGETS, rows, strict=True)
    ]
    words = f"objects drawn for {count} scenes; the network is {shop.effort.network}"
    return Curve(points=tuple(points), measured_on=f"{words}, {shop.effort.network_px} pixels")


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
        "takes the finest levels that it can hold. Making them costs milliseconds; what "
        "triangles cost is the network's time, at every visit.",
        measure=measure_budget,
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
    ),
)
