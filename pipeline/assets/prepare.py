"""One object: from a file to an `Asset`. It runs in a child process: native code may end it."""

from pathlib import Path

import numpy as np

from pipeline.assets.clean import clean, geometry_sha256, normalise
from pipeline.assets.decimation import decimate, safe_method
from pipeline.assets.distance import Surface
from pipeline.assets.gate import check_level
from pipeline.assets.guards import check_clean, check_raw
from pipeline.assets.load import load_mesh
from pipeline.assets.mesh import TriangleMesh
from pipeline.assets.orient import orient_outward
from pipeline.assets.recipe import METHODS, RECIPE
from pipeline.assets.settings import AssetSettings
from pipeline.assets.source_file import read_source
from storage.asset import Asset, Level, LevelRecord
from storage.errors import Rejected
from storage.records import ObjectRecord
from storage.seeds import rng_for

_ERROR_SAMPLES = 8192
"""Points per direction: the 99th percentile is then known to within 98.7 to 99.3 (3 sigma)."""


def prepare_asset(record: ObjectRecord, settings: AssetSettings, method: str = METHODS[0]) -> Asset:
    """Return the clean, outward oriented object at all budgets that keep the error bound.

    Args:
        record: names the file; its path is the only one that is opened, with the buffers that a
            glTF names below the same folder.
        settings: budgets and limits.
        method: one of METHODS, for the levels that need fewer triangles than the source has.

    Raises:
        Rejected: the object is unusable; the reason codes are those of the steps.

    What it does not do: close holes, remove inner parts, keep textures, or make the triangles
    even. Parts below one percent of the area may vanish unnoticed by the error bound.
    """
    source = read_source(Path(record.path), settings)
    raw = load_mesh(source)
    check_raw(raw, source.kind, settings)
    cleaned = clean(normalise(raw))
    check_clean(cleaned)
    mesh = orient_outward(cleaned)
    return Asset(
        geometry_sha256=geometry_sha256(cleaned),
        source_sha256=source.sha256,
        recipe=RECIPE,
        levels=_levels(mesh, settings, safe_method(mesh, method)),
    )


def _levels(mesh: TriangleMesh, settings: AssetSettings, method: str) -> tuple[Level, ...]:
    """Return the levels, from the largest budget; raises the first failure where none is left.

    A budget that the level before it meets as well gets no level of its own.
    """
    levels: list[Level] = []
    failures: list[Rejected] = []
    surface = Surface(mesh, rng_for(0, "asset-error").random((_ERROR_SAMPLES, 3)))
    for budget in settings.budgets:
        if levels and len(levels[-1].faces) <= budget:
            continue
        if len(mesh.faces) <= budget:
            levels.append(_level(mesh, budget, "source", 0.0))
            continue
        try:
            result = decimate(mesh, budget, method)
            smaller, error = check_level(result, surface, budget, settings.max_error_p99)
            levels.append(_level(smaller, budget, method, error))
        except Rejected as failure:
            failures.append(failure)
    if not levels:
        raise failures[0]
    return tuple(levels)


def _level(mesh: TriangleMesh, budget: int, method: str, error_p99: float) -> Level:
    """Clean positions lie on a grid that float32 holds exactly."""
    return Level(
        record=LevelRecord(budget=budget, method=method, error_p99=error_p99),
        positions=mesh.positions.astype(np.float32),
        faces=mesh.faces.astype(np.uint32),
    )
