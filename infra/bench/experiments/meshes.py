"""Experiment `meshes`: decimation methods, RenderFormer's recipe, and every budget of triangles."""

from functools import partial
from pathlib import Path

from infra.bench.context import BenchContext
from infra.bench.experiment import BenchScale, Column, Experiment, Figures, Point, percent
from infra.bench.workloads.coarser_meshes import (
    METHODS,
    REFERENCE,
    make_coarser_meshes,
    picture_db,
    remesh,
)
from infra.bench.workloads.traced_pictures import fixed_samples
from infra.bench_options import BenchOptions
from pipeline.assets.settings import AssetSettings
from storage.errors import Rejected

BUDGET = 512
"""Number of triangles at which methods are compared."""
CURVE = (64, 128, 256, 512, 1024)
PICTURED = 3
"""Number of objects that are path traced at every budget, which takes some seconds each."""
LARGE = 1100
"""Minimum number of clean triangles of an object, so that every budget removes some."""
METHOD_GROUP = f"methods, {BUDGET} triangles"
BUDGET_GROUP = "faithful, by budget"


def _points(scale: BenchScale, options: BenchOptions) -> list[Point]:
    methods = [
        Point(
            name=f"{METHOD_GROUP}, {method}",
            measure=partial(_simplify, method, BUDGET),
            default=method == AssetSettings.profile,
            group=METHOD_GROUP,
            kind="methods",
        )
        for method in (REFERENCE, *METHODS)
    ]
    budgets = [
        Point(
            name=f"{BUDGET_GROUP}, {budget}",
            measure=partial(_simplify_and_render, budget),
            group=BUDGET_GROUP,
            kind="budgets",
        )
        for budget in CURVE
    ]
    return [*methods, *budgets]


def _simplify(method: str, budget: int, context: BenchContext, trial: str) -> Figures:
    return context.mesh_child.call(remesh, _object(context, trial), method, budget)


def _simplify_and_render(budget: int, context: BenchContext, trial: str) -> Figures:
    """Measure `faithful` at a budget, with pictures if the object is path traced."""
    figures = _simplify("faithful", budget, context, trial)
    if _number(trial) > PICTURED:
        return figures
    pictures = context.get_or_make(("pictures", trial), lambda: _picture_db(context, trial))
    return {
        **figures, "picture_db": pictures[CURVE.index(budget)], "again_db": pictures[-1]
    }  # fmt: skip


def _picture_db(context: BenchContext, trial: str) -> list[float]:
    method = METHODS["faithful"]
    meshes = context.mesh_child.call(make_coarser_meshes, _object(context, trial), CURVE, method)
    renders = fixed_samples(context.scale.picture_px, context.scale.max_spp // 4)
    return context.child.call(picture_db, meshes, renders)


def _object(context: BenchContext, trial: str) -> Path:
    large = [path for path, faces in context.mesh_files if faces >= LARGE]
    if _number(trial) > len(large):
        raise Rejected("no_object", f"only {len(large)} objects have {LARGE} triangles")
    return large[_number(trial) - 1]


def _number(trial: str) -> int:
    return int(trial.split()[-1])


EXPERIMENT = Experiment(
    name="meshes",
    title="Coarser meshes: methods and budgets",
    about=f"Objects of {LARGE} triangles or more, simplified by each of our methods and by the "
    "reference recipe (isotropic remeshing at 0.5 %, then quadric collapse), and by `faithful` to "
    "several budgets. The largest few are also path traced beside their source, on a floor under "
    "a lamp.",
    cost=Column(name="core-seconds an object", figure="cpu_s"),
    error=Column(
        name="distance to the source, p99, % of the diagonal", figure="error_p99", then=percent
    ),
    columns=(
        Column(name="triangles", figure="faces"),
        Column(name="mean distance, %", figure="error_mean", then=percent),
        Column(name="area variation", figure="area_variation"),
        Column(name="smallest angles, degrees", figure="min_angle_p5_deg"),
        Column(name="picture, psnr_log_db", figure="picture_db"),
        Column(name="the source with other samples, psnr_log_db", figure="again_db"),
    ),
    because="Distances are two-way, to the cleaned source; medians over the objects. `uniform` is "
    "for uses that need even triangles, at more error and more time.",
    points=_points,
    trials=lambda scale, options: [f"object {number}" for number in range(1, scale.objects + 1)],
)
