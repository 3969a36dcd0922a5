"""What geometry costs: triangles of a scene, against the error of its objects and its picture."""

import contextlib
from collections.abc import Iterable, Sequence

import numpy as np

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Figures, Point, percent
from infra.bench.experiments.meshes import NETWORK
from infra.bench.experiments.sampling import DB, WORST
from infra.bench.subjects.scene_detail import ERRORS, Fit, picture_errors, scene_fits
from infra.bench.workshop import Workshop
from pipeline.builds.training import pretrain_256
from storage.errors import Rejected

SCENE_BUDGETS = (768, 1024, 1536, 2048, 4096)
FINEST = "finest, other samples"


def _measure_fits(
    workshop: Workshop, points: Sequence[Point], turn: str
) -> Iterable[tuple[str, Figures]]:
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


def _measure_detail(
    workshop: Workshop, points: Sequence[Point], turn: str
) -> Iterable[tuple[str, Figures]]:
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
        because="Default: 1536 in the first stage as published, 4096 in the second. Attention "
        "grows with the square, and the worst objects decide what a budget loses. Scenes "
        "are not filled up (`fill_to`): triangles that change no surface cost the network "
        "the same.",
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
        against="the path traced picture of the finest meshes (at most 1400 triangles each); "
        "median over the scenes. The last row is that picture itself with other samples: nothing "
        "can be told above it",
        columns=(
            WORST,
            Column(name="object triangles", figure="triangles", over="mean"),
        ),
        because="Default: 0.5 % at 256 pixels, 0.25 % at 512. Facets and outlines move highlights "
        "long before a distance is seen; but every picture of a set is of the very triangles that "
        "the network is given, so this is no error of the labels.",
        points=_details,
        turns=lambda effort: [f"smoke {index}" for index in range(max(2, effort.scenes // 2))],
        measure=_measure_detail,
        needs=("torch",),
    ),
)
