"""Meshes: error, evenness and time against the reference recipe; growth; what epsilon saves.

Every remeshing runs in a child of its own with a limit on its processor time. A comparison uses the
objects that every side of it finished, and says how many that are.
"""

import contextlib
import dataclasses
import functools
import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from infra.bench import remeshing
from infra.bench.harness import Comparison, Options, compare
from pipeline.assets.settings import AssetSettings, GateSettings
from pipeline.assets.stage import prepare_assets
from pipeline.assets.store import AssetStore
from pipeline.flows.children import ChildPool
from pipeline.flows.prepare_isolated import asset_child, preload_mesh_libraries
from pipeline.isolation import ChildFailed, ChildLimits, IsolatedChild
from pipeline.objects.builtin.torus_knot import TorusKnotParams, torus_knot
from pipeline.objects.sources import find_objects
from storage.asset import decode_asset
from storage.cache import cache_folder
from storage.errors import Rejected
from storage.ply import encode_ply
from storage.records import ObjectRecord

NAME = "assets"
BUDGETS = (512, 4096)
"""Of the comparison with the reference recipe."""
CURVE = (64, 128, 256, 512, 1024)
_CURVE_SOURCE = 1500
"""Faces that a source of the curve has at least, so that every budget is a decimation."""
EPSILON = 0.005
FIXED = 4096
SIZES = (1_000, 10_000, 100_000, 1_000_000)
_LIMITS = ChildLimits(memory_bytes=8 << 30, wall_s=600, cpu_s=240, calls_per_child=1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Effort:
    """How much to measure."""

    most_objects: int
    """Objects of a comparison, the largest first."""
    sizes: tuple[int, ...]
    """Faces of the sources of the growth."""
    repeats: int
    """Counted rounds."""


CAREFUL = Effort(most_objects=24, sizes=SIZES, repeats=2)
QUICK = Effort(most_objects=4, sizes=SIZES[:2], repeats=1)


def run(options: Options, round_done: Callable[[], None]) -> Comparison:
    """Measure on the objects of all sources together."""
    preload_mesh_libraries()
    effort, records = _effort(options), object_records(options)
    with tempfile.TemporaryDirectory() as work, contextlib.closing(_child()) as child:
        sizes = clean_sizes(child, records)
        sides = {
            **_comparisons(child, sizes, effort),
            **_curves(child, sizes, effort),
            **_growth(child, Path(work), effort),
            **_stages(records),
        }
        return compare(NAME, sides, repeats=effort.repeats, round_done=round_done)


def num_rounds(options: Options) -> int:
    """Return how often `round_done` will be called."""
    effort = _effort(options)
    sides = len(BUDGETS) * (1 + len(remeshing.METHODS)) + len(CURVE) * len(remeshing.METHODS)
    return (sides + len(effort.sizes) + len(_workers()) + 2) * (1 + effort.repeats)


def _effort(options: Options) -> Effort:
    return QUICK if options.quick else CAREFUL


def _child() -> IsolatedChild:
    return IsolatedChild(limits=_LIMITS, setup=_nothing)


def _nothing() -> None:
    """The fork server has imported everything already."""


def object_records(options: Options) -> list[ObjectRecord]:
    """Return the objects of all sources together; raises TrilightError as `find_objects`."""
    return [
        record
        for source in options.objects
        for record in find_objects(
            source,
            work_dir=cache_folder("objects"),
            allowed_licences=options.allowed_licences,
        ).records
    ]


def clean_sizes(child: IsolatedChild, records: list[ObjectRecord]) -> dict[Path, int]:
    """Return the faces after cleaning of every usable source, the largest first."""
    sizes = {}
    for record in records:
        with contextlib.suppress(Rejected, ChildFailed):
            sizes[Path(record.path)] = child.call(remeshing.count_faces, Path(record.path))
    return dict(sorted(sizes.items(), key=lambda item: (-item[1], str(item[0]))))


def _comparisons(
    child: IsolatedChild, sizes: Mapping[Path, int], effort: Effort
) -> dict[str, Callable[[], Mapping[str, float]]]:
    sides: dict[str, Callable[[], Mapping[str, float]]] = {}
    for budget in BUDGETS:
        paths = [path for path, faces in sizes.items() if faces > budget][: effort.most_objects]
        for side in (remeshing.REFERENCE, *remeshing.METHODS):
            sides[f"{side} at {budget}"] = medians_side(child, paths, side, budget)
    return sides


def _curves(
    child: IsolatedChild, sizes: Mapping[Path, int], effort: Effort
) -> dict[str, Callable[[], Mapping[str, float]]]:
    paths = [path for path, faces in sizes.items() if faces > _CURVE_SOURCE]
    return {
        f"curve {side} at {budget}": medians_side(child, paths[: effort.most_objects], side, budget)
        for side in remeshing.METHODS
        for budget in CURVE
    }


def medians_side(
    child: IsolatedChild, paths: list[Path], side: str, budget: int
) -> Callable[[], Mapping[str, float]]:
    """Return a run over `paths`; what one side cannot do is taken from all (the list is shared)."""

    def measure() -> Mapping[str, float]:
        rows = []
        for path in list(paths):
            try:
                rows.append(child.call(remeshing.remesh, path, side, budget))
            except (Rejected, ChildFailed):
                paths.remove(path)
        if not rows:
            return {"objects": 0}
        medians = {name: float(np.median([row[name] for row in rows])) for name in rows[0]}
        over = sum(row["faces"] > budget for row in rows)
        return {**medians, "objects": len(rows), "over_budget": over}

    return measure


def _growth(
    child: IsolatedChild, work: Path, effort: Effort
) -> dict[str, Callable[[], Mapping[str, float]]]:
    settings = AssetSettings(budgets=(1400,))
    sides: dict[str, Callable[[], Mapping[str, float]]] = {}
    for faces in effort.sizes:
        path = work / f"{faces}.ply"
        path.write_bytes(encode_ply(*_knot(faces)))
        method = remeshing.METHODS["faithful"]
        sides[f"source of {faces}"] = functools.partial(
            child.call, remeshing.prepare, path, settings, method
        )
    return sides


def _knot(faces: int):  # type: ignore[no-untyped-def]
    """A closed tube of about so many triangles."""
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
    return torus_knot(params)


def _workers() -> tuple[int, ...]:
    cores = os.cpu_count() or 1
    return (1,) if cores == 1 else (1, cores)


def _stages(records: list[ObjectRecord]) -> dict[str, Callable[[], Mapping[str, float]]]:
    """Return the whole stage on all objects: by number of workers, fixed budget and epsilon."""
    sides = {
        f"stage, {workers} workers": _stage(records, AssetSettings(), workers)
        for workers in _workers()
    }
    fixed = AssetSettings(budgets=(FIXED,))
    bounded = dataclasses.replace(fixed, epsilon=EPSILON, gate=GateSettings())
    most = _workers()[-1]
    sides[f"budget {FIXED}"] = _stage(records, fixed, most)
    sides[f"epsilon {EPSILON:.1%}"] = _stage(records, bounded, most)
    return sides


def _stage(
    records: list[ObjectRecord], settings: AssetSettings, workers: int
) -> Callable[[], Mapping[str, float]]:
    def measure() -> Mapping[str, float]:
        pool = ChildPool(lambda _: asset_child(), workers)
        with tempfile.TemporaryDirectory() as store, contextlib.closing(pool):
            prepared, failures = prepare_assets(
                records,
                settings,
                AssetStore(Path(store)),
                borrow_child=pool.borrow,
                workers=workers,
                done=lambda: None,
            )
            finest = [decode_asset(asset.path.read_bytes()).levels[0] for asset in prepared]
        faces = [len(level.faces) for level in finest]
        errors = [level.record.quality.error_p99 for level in finest]
        return {
            "accepted": len(prepared),
            "rejected": len(failures),
            "faces_mean": float(np.mean(faces)),
            "faces_median": float(np.median(faces)),
            "error_p99_max": max(errors),
            "over_epsilon": sum(error > EPSILON for error in errors),
        }

    return measure
