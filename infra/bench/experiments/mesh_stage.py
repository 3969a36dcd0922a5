"""The whole mesh stage: objects a minute, what an error bound saves, and growth with the source."""

import contextlib
import os
from pathlib import Path

import numpy as np

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Figures, Point, one_by_one, percent, repeats
from infra.bench.sides import remeshing
from infra.bench.workshop import Workshop
from pipeline.assets.settings import AssetSettings
from pipeline.assets.stage import prepare_assets
from pipeline.assets.store import AssetStore
from pipeline.making.children import ChildPool
from pipeline.making.prepare_isolated import asset_child
from pipeline.objects.builtin.torus_knot import TorusKnotParams, torus_knot
from pipeline.objects.ply import encode_ply
from storage.records.asset import decode_asset

FIXED, EPSILON = 4096, 0.005


def _stages(effort: Effort) -> list[Point]:
    cores = os.cpu_count() or 1
    points = [
        Point(name=f"six levels, {workers} workers", settings=(AssetSettings(), workers))
        for workers in sorted({1, cores})
    ]
    bounded = AssetSettings(budgets=(FIXED,), epsilon=EPSILON)
    return [
        *points,
        Point(name=f"budget {FIXED}", settings=(AssetSettings(budgets=(FIXED,)), cores)),
        Point(name=f"epsilon {EPSILON:.1%}", settings=(bounded, cores)),
    ]


def _stage(workshop: Workshop, point: Point, turn: str) -> Figures:
    """Prepare all objects with a store that is empty, and say what became of them."""
    settings, workers = point.settings
    pool = ChildPool(lambda _: asset_child(), workers)
    with contextlib.closing(pool):
        prepared, failures = prepare_assets(
            workshop.objects,
            settings,
            AssetStore(workshop.folder()),
            borrow_child=pool.borrow,
            workers=workers,
            done=lambda: None,
        )
    finest = [decode_asset(asset.path.read_bytes()).levels[0] for asset in prepared]
    errors = [level.record.quality.error_p99 for level in finest]
    return {
        "objects": float(len(prepared) + len(failures)),
        "accepted": float(len(prepared)),
        "faces": float(np.mean([len(level.faces) for level in finest])),
        "largest": max(errors),
        "over": float(sum(error > EPSILON for error in errors)),
    }


def _rate(workshop: Workshop, point: Point, turn: str) -> Figures:
    found = next(iter(one_by_one(_stage)(workshop, [point], turn)))[1]
    return {**found, "an_object_s": found["seconds"] / found["objects"]}


def _knot(faces: int, folder: Path) -> Path:
    """Write a closed tube of about so many triangles."""
    sides = max(8, round((faces / 26) ** 0.5))
    params = TorusKnotParams(
        windings=(2, 3),
        minor_radius=0.45,
        fill=0.6,
        ribs=3,
        rib_depth=0.4,
        rib_turns=1,
        flatten=0.8,
        segments=round(faces / (2 * sides)),
        sides=sides,
    )
    path = folder / f"{faces}.ply"
    path.write_bytes(encode_ply(*torus_knot(params)))
    return path


def _growth(workshop: Workshop, point: Point, turn: str) -> Figures:
    path = workshop.kept(point.name, lambda: _knot(point.settings, workshop.folder()))
    settings = AssetSettings(budgets=(1400,))
    return workshop.mesh_child.call(
        remeshing.prepare, path, settings, remeshing.METHODS["faithful"]
    )


EXPERIMENTS = (
    Experiment(
        name="mesh-stage",
        title="The mesh stage",
        about=(
            "All objects, from their files to measured meshes in an empty asset store, "
            "prepared in child processes."
        ),
        cost=Column(name="seconds an object, on the clock", figure="an_object_s"),
        columns=(
            Column(name="objects a minute", figure="an_object_s", then=lambda s: 60 / s),
            Column(name="objects", figure="objects"),
            Column(name="accepted", figure="accepted"),
            Column(name="triangles, mean of the finest", figure="faces"),
            Column(name="largest p99 distance %", figure="largest", then=percent),
            Column(name=f"beyond {EPSILON:.1%}", figure="over"),
        ),
        points=_stages,
        turns=repeats,
        measure=one_by_one(_rate),
    ),
    Experiment(
        name="mesh-growth",
        title="The mesh stage by size of the source",
        about=(
            "A closed tube with a growing number of triangles, from its file to one level of "
            "1400 triangles."
        ),
        cost=Column(name="core-seconds", figure="cpu_s"),
        points=lambda effort: [
            Point(name=f"{faces} triangles", settings=faces)
            for faces in (10**power for power in range(3, 3 + effort.growth))
        ],
        turns=repeats,
        measure=one_by_one(_growth),
        warm_up=True,
    ),
)
