"""Watertight meshes on demand: the nearest closed, oriented, manifold form of a source."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipeline.assets.cleaning.clean import clean
from pipeline.assets.cleaning.surface_around import surface_around
from pipeline.assets.decimation.decimate import collapse_by_qslim
from pipeline.assets.quality.level_checks import check_level, require_watertight
from pipeline.assets.quality.measure import MeasuredSource, open_half_edges
from pipeline.assets.settings import AssetSettings, GateSettings
from pipeline.foreign.mesh import TriangleMesh
from storage.errors import Rejected

_FEWEST = 16384
_DETOUR = 4
"""Multiple of the largest budget, or else `_FEWEST`, to which a mesh is collapsed once for all
levels: libigl's collapse takes 19 us a triangle, and keeps it watertight."""

Form = Literal["source", "capped", "solid", "hollow"]


@dataclass(frozen=True, kw_only=True, eq=False)
class LevelBase:
    """The mesh from which levels are made."""

    mesh: TriangleMesh
    start: TriangleMesh
    """The same surface with as many triangles as decimation begins with."""
    gate: GateSettings
    """Quality checks of its levels."""
    form: Form = "source"
    """`source`: the cleaned source. `capped`: with its holes closed. `solid`: a new surface around
    all that the outside does not reach. `hollow`: a new surface whose cavities, with what is in
    them, keep their walls."""


def make_watertight(source: MeasuredSource, settings: AssetSettings) -> LevelBase:
    """Repair a mesh: return its first watertight form that passes the quality checks.

    The checks of a new surface admit twice the area: a plate has two sides.

    Raises:
        Rejected: no form passes; with the reason of `solid`.
    """
    low, high = settings.gate.area_ratio
    two_sided = replace(settings.gate, area_ratio=(low, 2 * high))
    gates: dict[Form, GateSettings] = {"source": settings.gate, "capped": settings.gate}
    gates |= {"solid": two_sided, "hollow": two_sided}
    refusals: dict[Form, Rejected] = {}
    for form, gate in gates.items():
        mesh = _in_form(source.mesh, form)
        try:
            require_watertight(mesh)
            check_level(mesh, source, len(mesh.faces), gate, gate.max_error_p99)
        except Rejected as refusal:
            refusals[form] = refusal
            continue
        fewer = max(_FEWEST, _DETOUR * settings.budgets[0])
        start = mesh if len(mesh.faces) <= fewer else collapse_by_qslim(mesh, fewer)
        return LevelBase(mesh=mesh, start=start, gate=gate, form=form)
    reason = refusals["solid"]
    raise Rejected(reason.reason, f"made watertight: {reason.message}")


def _in_form(mesh: TriangleMesh, form: Form) -> TriangleMesh:
    if form == "source":
        return mesh
    if form == "capped":
        return _cap_holes(mesh)
    return surface_around(mesh, fills=form == "solid")


def _cap_holes(mesh: TriangleMesh) -> TriangleMesh:
    """Return a clean mesh with each connected border closed by a fan around its middle."""
    count = len(mesh.positions)
    border = open_half_edges(mesh)
    links = coo_array((np.ones(len(border)), tuple(border.T)), shape=(count, count))
    _, holes = np.unique(connected_components(links)[1][border[:, 0]], return_inverse=True)
    sums = [np.bincount(holes, weights=axis) for axis in mesh.positions[border[:, 0]].T]
    middles = np.stack(sums, axis=-1) / np.bincount(holes)[:, None]
    fans = np.column_stack([border[:, 1], border[:, 0], count + holes])
    return clean(
        TriangleMesh(
            positions=np.concatenate([mesh.positions, middles]),
            faces=np.concatenate([mesh.faces, fans]),
        )
    )
