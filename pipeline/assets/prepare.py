"""Prepares one object: from a file to an `Asset`, in a child process that may crash."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.attempt import AssetAttempt
from pipeline.assets.cleaning.clean import clean, geometry_sha256, normalize
from pipeline.assets.cleaning.guards import check_clean, check_raw
from pipeline.assets.cleaning.orient import orient_outward
from pipeline.assets.decimation.by_name import decimate, safe_method
from pipeline.assets.decimation.smallest import smallest_passing
from pipeline.assets.quality.level_checks import check_level
from pipeline.assets.quality.measure import MeasuredSource
from pipeline.assets.quality.triangles import count_edges
from pipeline.assets.recipe import RECIPE
from pipeline.assets.settings import AssetSettings
from pipeline.assets.source_materials.skin import add_source_materials
from pipeline.foreign.load import load_mesh
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.source_file import read_source
from storage.errors import Rejected
from storage.records.asset import Asset, Level, LevelQuality, LevelRecord, SourceFacts


def prepare_asset(
    path: Path, settings: AssetSettings, method: str, root: Path | None = None
) -> AssetAttempt:
    """Return the clean, outward oriented object at every budget that passes the quality checks.

    Args:
        path: the only file that is opened, with the buffers that a glTF names below its folder.
        settings: profile, budgets and limits.
        method: a name of `recipe.methods_of`, for levels other than the unchanged source.
        root: folder of its pictures, as in `read_source`.

    Raises:
        Rejected: the object is unusable by any method; each step has its reason codes.

    Holes stay open and inner components stay in.
    """
    source = read_source(path, settings.read_limits, root)
    raw = load_mesh(source)
    check_raw(raw, settings, is_single=source.is_single)
    cleaned = clean(normalize(raw))
    check_clean(cleaned)
    mesh, front_share = orient_outward(cleaned)
    measured = MeasuredSource(mesh)
    safe = safe_method(mesh, method)
    levels, missed = _levels(measured, settings, safe)
    levels, missed, materials = add_source_materials(levels, missed, source, mesh, settings)
    return AssetAttempt(
        method=safe,
        asset=Asset(
            geometry_sha256=geometry_sha256(cleaned),
            source_sha256=source.sha256,
            recipe=RECIPE,
            source=_facts(raw, cleaned, measured, front_share),
            levels=levels,
            materials=materials,
        ),
        missed=missed,
        unread=source.unread,
    )


def _facts(
    raw: TriangleMesh, cleaned: TriangleMesh, source: MeasuredSource, front_share: float
) -> SourceFacts:
    edges = count_edges(source.mesh)
    return SourceFacts(
        num_faces_read=len(raw.faces),
        num_faces=len(source.mesh.faces),
        num_faces_turned=_count_flipped(cleaned, source.mesh),
        num_parts=source.components.count,
        open_edges=edges.open,
        nonmanifold_edges=edges.nonmanifold,
        front_share=round(front_share, 6),
    )


def _count_flipped(before: TriangleMesh, after: TriangleMesh) -> int:
    """Count the faces whose winding changed: their canonical rows differ in the last two."""

    def second_corners(faces: NDArray[np.int64]) -> NDArray[np.int64]:
        low = faces[:, 1:].min(axis=1)
        high = faces[:, 1:].max(axis=1)
        return faces[np.lexsort((high, low, faces[:, 0])), 1]

    return int((second_corners(before.faces) != second_corners(after.faces)).sum())


def _levels(
    source: MeasuredSource, settings: AssetSettings, method: str
) -> tuple[tuple[Level, ...], dict[int, tuple[str, str]]]:
    """Return the levels from the largest budget, and the reasons of the missing ones.

    A budget that the level before it meets as well gets no level.
    """
    builder = _LevelBuilder(source, settings, method)
    levels: list[Level] = []
    missed: dict[int, tuple[str, str]] = {}
    for budget in settings.budgets:
        if levels and len(levels[-1].faces) <= budget:
            continue
        try:
            finest = budget == settings.budgets[0]
            levels.append(builder.smallest(budget) if finest else builder.level(budget))
        except Rejected as failure:
            missed[budget] = (failure.reason, failure.message)
    return tuple(levels), missed


class _LevelBuilder:
    """Builds the levels of one source by one method."""

    def __init__(self, source: MeasuredSource, settings: AssetSettings, method: str) -> None:
        self._mesh = source.mesh
        self._source = source
        self._settings = settings
        self._method = method

    def smallest(self, budget: int) -> Level:
        """Return the smallest level within the mesh tolerance, or else that of `budget`."""
        epsilon = self._settings.epsilon
        if epsilon is None:
            return self.level(budget)
        largest = min(budget, len(self._mesh.faces)) if self._keeps_source else budget
        try:
            best = smallest_passing(lambda faces: self._make(faces, epsilon), largest)
        except Rejected:
            return self.level(budget)
        return _level(budget, *best)

    def level(self, budget: int) -> Level:
        """Return the level of a budget; raises Rejected where it fails the quality checks."""
        return _level(budget, *self._make(budget, self._settings.gate.max_error_p99))

    @property
    def _keeps_source(self) -> bool:
        """True where a source within budget is used unchanged: its triangles need not be even."""
        return self._settings.profile == "faithful"

    def _make(self, faces: int, max_error_p99: float) -> tuple[str, TriangleMesh, LevelQuality]:
        if self._keeps_source and len(self._mesh.faces) <= faces:
            return "source", self._mesh, self._source.source_quality()
        result = decimate(self._mesh, faces, self._method)
        gate = self._settings.gate
        mesh, quality = check_level(result, self._source, faces, gate, max_error_p99)
        return self._method, mesh, quality


def _level(budget: int, method: str, mesh: TriangleMesh, quality: LevelQuality) -> Level:
    """Return a level; clean positions lie on a grid that float32 holds exactly."""
    return Level(
        record=LevelRecord(budget=budget, method=method, quality=quality),
        positions=mesh.positions.astype(np.float32),
        faces=mesh.faces.astype(np.uint32),
    )
