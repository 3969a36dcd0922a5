"""What geometry costs: triangles of an object, against error, picture, network."""

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from infra.bench.effort import Effort
from infra.bench.experiment import (
    Column,
    Experiment,
    Figures,
    Point,
    TurnFigures,
    one_by_one,
    percent,
)
from infra.bench.sides import remeshing
from infra.bench.sides.shots import fixed_samples
from infra.bench.subjects.mesh_pictures import coarser, picture_db
from infra.bench.workshop import Workshop
from pipeline.assets.settings import AssetSettings
from pipeline.builds.training import pretrain_256
from storage.errors import Rejected

CURVE = (64, 128, 256, 512, 1024)
OBJECTS = 2
"""Objects of the scene that the budget of one object is priced in."""
PICTURED = 3
"""Objects that are path traced at every budget: some seconds each."""
LARGE = 1100
"""Clean triangles of an object that is decimated, so that most budgets take something away."""
VERY_LARGE = 4097
EPSILONS = (None, 0.02, 0.01, 0.005, 0.0025)


def _objects(effort: Effort) -> tuple[str, ...]:
    return tuple(f"object {number}" for number in range(1, effort.objects + 1))


def _remeshed(workshop: Workshop, point: Point, turn: str) -> Figures:
    """Remesh one object one way; the settings are method, budget, least triangles of objects."""
    method, budget, least = point.settings
    return workshop.mesh_child.call(remeshing.remesh, workshop.source(turn, least), method, budget)


def _recipes(budget: int, least: int) -> list[Point]:
    return [
        Point(
            name=method,
            settings=(method, budget, least),
            default=method == AssetSettings.profile,
        )
        for method in (remeshing.REFERENCE, *remeshing.METHODS)
    ]


def _measure_budget(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    """Measure one object at every budget, and the picture of the few that are path traced."""
    path, effort = workshop.source(turn, LARGE), workshop.effort
    budgets, pictures = [point.settings for point in points], []
    found = [
        workshop.mesh_child.call(remeshing.remesh, path, "faithful", budget) for budget in budgets
    ]
    if int(turn.split()[-1]) <= PICTURED:
        method = remeshing.METHODS["faithful"]
        meshes = workshop.mesh_child.call(coarser, path, budgets, method)
        renders = fixed_samples(effort.picture_px, effort.fixed_spp)
        pictures = workshop.call(picture_db, meshes, renders)
    for row, (point, figures) in enumerate(zip(points, found, strict=True)):
        cost = workshop.network_core_s(OBJECTS * figures["faces"])
        picture = {"picture_db": pictures[row], "again_db": pictures[-1]} if pictures else {}
        yield point.name, {**figures, **picture, "network_s": cost}


def _budgets(effort: Effort) -> list[Point]:
    room = pretrain_256().scenes.max_triangles
    default = max(budget for budget in CURVE if OBJECTS * budget <= room)
    return [
        Point(name=f"{budget} triangles", settings=budget, default=budget == default)
        for budget in CURVE
    ]


def prepared(path: Path, epsilon: float | None) -> dict[str, float]:
    """Return triangles, distance and core-seconds of the whole stage; in a mesh child."""
    from pipeline.assets.prepare import prepare_asset

    settings = AssetSettings(budgets=(AssetSettings.budgets[0],), epsilon=epsilon)
    started = time.process_time()
    levels = prepare_asset(path, settings, remeshing.METHODS["faithful"]).asset.levels
    if not levels:
        raise Rejected("no_level", "no level passed the gate")
    return {
        "faces": float(len(levels[0].faces)),
        "error_p99": levels[0].record.quality.error_p99,
        "cpu_s": time.process_time() - started,
    }


def _measure_epsilon(workshop: Workshop, point: Point, turn: str) -> Figures:
    return workshop.mesh_child.call(prepared, workshop.source(turn, LARGE), point.settings)


def _times_1000(value: float) -> float:
    return 1000 * value


_P99 = Column(
    name="two-way distance to the source, 99th percentile, % of the diagonal",
    figure="error_p99",
    then=percent,
)
_CPU = Column(name="core-seconds an object", figure="cpu_s")
_REMESHED = (
    Column(name="mean error %", figure="error_mean", then=percent),
    Column(name="area variation", figure="area_variation"),
    Column(name="smallest angles, degrees", figure="min_angle_p5_deg"),
    Column(name="triangles", figure="faces"),
)
NETWORK = Column(name="core-seconds of the network for a scene and one view", figure="network_s")

_of_objects = partial(
    Experiment, error=_P99, against="the cleaned source; median over the objects", turns=_objects
)
"""Declares an experiment on objects, judged by their distance to the source."""

EXPERIMENTS = (
    _of_objects(
        name="budget",
        title="Triangles of an object",
        about=(
            "Objects at several budgets; the cost is the network's time for a scene with two "
            "of them. The largest few are also path traced beside their source, alone on a "
            "floor under a lamp."
        ),
        covers=("build.assets.budgets",),
        cost=NETWORK,
        columns=(
            _REMESHED[0],
            Column(name="picture, psnr_log_db", figure="picture_db"),
            Column(name="the source with other samples, psnr_log_db", figure="again_db"),
            Column(name="making it, core-ms", figure="cpu_s", then=_times_1000),
        ),
        because="Default: six levels are kept of every object, so the budget is not chosen once. "
        "Each scene takes the finest levels that fit into its own budget; the table marks the "
        f"finest level of which a scene of 1536 triangles holds {OBJECTS}. Making the levels costs "
        "milliseconds; the price of triangles is the network's time at every visit.",
        points=_budgets,
        measure=_measure_budget,
        needs=("torch",),
    ),
    _of_objects(
        name="profile",
        title="How objects are made coarser, at 512 triangles",
        about=(
            "Objects simplified by each of our methods, and by the reference recipe: isotropic "
            "remeshing at 0.5 %, then quadric collapse."
        ),
        covers=("build.assets.profile",),
        cost=_CPU,
        columns=_REMESHED,
        because=(
            "Default: `faithful`, which has the least error for its triangles; triangles are "
            "paid for at every visit. `uniform` is for uses that need even triangles, at more "
            "error and more time."
        ),
        points=lambda effort: _recipes(512, LARGE),
        measure=one_by_one(_remeshed),
    ),
    _of_objects(
        name="profile-4096",
        title="How large objects are made coarser, at 4096 triangles",
        about="As above, for the objects that have more than 4096 triangles.",
        cost=_CPU,
        columns=_REMESHED,
        points=lambda effort: _recipes(4096, VERY_LARGE),
        measure=one_by_one(_remeshed),
    ),
    _of_objects(
        name="epsilon",
        title="An error bound in place of a budget",
        about=f"Objects of {LARGE} triangles or more, prepared within a distance to their source, "
        f"with at most {AssetSettings.budgets[0]} triangles.",
        covers=("build.assets.epsilon",),
        cost=Column(name="triangles an object", figure="faces", over="mean"),
        columns=(
            Column(name="largest error %", figure="error_p99", over="most", then=percent),
            Column(name="making it, core-s", figure="cpu_s", over="mean"),
        ),
        because=(
            "Default: no bound in the builds, since each scene already chooses among six "
            "levels by its own budget. `trilight assets --epsilon` is for meshes that are used "
            "elsewhere."
        ),
        points=lambda effort: [
            Point(
                name="none" if epsilon is None else f"{100 * epsilon:g} %",
                settings=epsilon,
                default=epsilon == AssetSettings.epsilon,
            )
            for epsilon in EPSILONS
        ],
        measure=one_by_one(_measure_epsilon),
    ),
)
