"""Prepares one object: from a file to an `Asset`, in a child process that may crash."""

import contextlib
from functools import partial
from pathlib import Path

import numpy as np

from pipeline.assets.cleaning.clean import check_clean, check_raw, clean, geometry_sha256, normalize
from pipeline.assets.cleaning.orient import orient_outward
from pipeline.assets.decimation.decimate import decimate, safe_method, smallest_passing
from pipeline.assets.quality.measure import (
    MeasuredSource,
    check_level,
    faces_of_edges,
    require_watertight,
)
from pipeline.assets.recipe import RECIPE
from pipeline.assets.settings import AssetSettings
from pipeline.assets.source_materials.skin import add_source_materials
from pipeline.assets.stage import AssetAttempt
from pipeline.assets.watertight import LevelBase, make_watertight
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.source_file import load_mesh, read_source
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

    Holes stay open and inner components stay in, unless `settings.watertight`.
    """
    source = read_source(path, settings.read_limits, root)
    raw = load_mesh(source)
    check_raw(raw, settings, is_single=source.is_single)
    cleaned = clean(normalize(raw))
    check_clean(cleaned)
    mesh, front_share = orient_outward(cleaned)
    measured = MeasuredSource(mesh)
    base = (
        make_watertight(measured, settings)
        if settings.watertight
        else LevelBase(mesh=mesh, start=mesh, gate=settings.gate)
    )
    shared = faces_of_edges(mesh)
    safe = safe_method(base.start, method)
    levels, missed = _levels(measured, base, settings, safe)
    levels, missed, materials = add_source_materials(
        levels, missed, source, measured.surface, settings
    )
    return AssetAttempt(
        method=safe,
        asset=Asset(
            geometry_sha256=geometry_sha256(cleaned),
            source_sha256=source.sha256,
            recipe=RECIPE,
            source=SourceFacts(
                num_faces_read=len(raw.faces),
                num_faces=len(mesh.faces),
                num_faces_turned=_count_flipped(cleaned, mesh),
                num_parts=measured.num_components,
                open_edges=int((shared == 1).sum()),
                nonmanifold_edges=int((shared > 2).sum()),
                front_share=round(front_share, 6),
            ),
            levels=levels,
            materials=materials,
        ),
        missed=missed,
        unread=source.unread,
    )


def _count_flipped(before: TriangleMesh, after: TriangleMesh) -> int:
    """Count the faces whose winding changed: their canonical rows differ in the last two."""
    seconds = []
    for faces in (before.faces, after.faces):
        low, high = np.sort(faces[:, 1:], axis=1).T
        seconds.append(faces[np.lexsort((high, low, faces[:, 0])), 1])
    return int((seconds[0] != seconds[1]).sum())


def _levels(
    source: MeasuredSource, base: LevelBase, settings: AssetSettings, method: str
) -> tuple[tuple[Level, ...], dict[int, tuple[str, str]]]:
    """Return the levels from the largest budget, and the reasons of the missing ones.

    A budget that the level before it meets as well gets no level. At the largest budget, the
    smallest level within the mesh tolerance `epsilon` is taken where there is one.
    """
    num_faces = len(base.mesh.faces)
    # A source within budget is used unchanged where its triangles need not be even.
    keeps_source = settings.profile == "faithful"
    is_source = base.form == "source"

    def make(max_error_p99: float, faces: int) -> tuple[str, TriangleMesh, LevelQuality]:
        if keeps_source and num_faces <= faces and is_source:
            return "source", source.mesh, source.source_quality()
        result = decimate(base.start, faces, method)
        mesh, quality = check_level(result, source, faces, base.gate, max_error_p99)
        if settings.watertight:
            require_watertight(mesh)
        return method if is_source else f"{base.form} {method}", mesh, quality

    levels: list[Level] = []
    missed: dict[int, tuple[str, str]] = {}
    for budget in settings.budgets:
        if levels and len(levels[-1].faces) <= budget:
            continue
        made = None
        if settings.epsilon is not None and budget == settings.budgets[0]:
            largest = min(budget, num_faces) if keeps_source else budget
            with contextlib.suppress(Rejected):
                made = smallest_passing(partial(make, settings.epsilon), largest)
        try:
            used_method, mesh, quality = made or make(settings.gate.max_error_p99, budget)
        except Rejected as failure:
            missed[budget] = (failure.reason, failure.message)
            continue
        levels.append(
            Level(
                record=LevelRecord(budget=budget, method=used_method, quality=quality),
                positions=mesh.positions.astype(np.float32),  # holds the grid of clean ones exactly
                faces=mesh.faces.astype(np.uint32),
            )
        )
    return tuple(levels), missed
