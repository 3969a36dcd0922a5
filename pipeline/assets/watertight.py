"""Watertight meshes on demand: the nearest closed, oriented, manifold form of a source.

Where nothing else closes it, that is the surface at a distance of one cell of a grid, pulled back
toward the mesh. Marching tetrahedra (Doi and Koide 1991) over Kuhn's six tetrahedra of each cube
make it. Unlike marching cubes, whose diagonals may coincide, they make no other kind of surface,
and moving vertices changes no connection. Open surfaces become thin plates; gaps below two cells
close.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label, maximum_filter
from trimesh.graph import connected_component_labels

from pipeline.assets.cleaning.clean import clean
from pipeline.assets.decimation.decimate import collapse_by_qslim
from pipeline.assets.quality.measure import (
    MeasuredSource,
    check_level,
    open_half_edges,
    require_watertight,
)
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
    forms: dict[Form, tuple[GateSettings, Callable[[TriangleMesh], TriangleMesh]]] = {
        "source": (settings.gate, lambda mesh: mesh),
        "capped": (settings.gate, _fill_holes),
        "solid": (two_sided, partial(surface_around, fills=True)),
        "hollow": (two_sided, partial(surface_around, fills=False)),
    }
    refusals: dict[Form, Rejected] = {}
    for form, (gate, make) in forms.items():
        mesh = make(source.mesh)
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


def _fill_holes(mesh: TriangleMesh) -> TriangleMesh:
    """Return a clean mesh with each connected border closed by a fan around its middle."""
    count = len(mesh.positions)
    border = open_half_edges(mesh)
    component = connected_component_labels(border, count)
    _, holes = np.unique(component[border[:, 0]], return_inverse=True)
    sums = [np.bincount(holes, weights=axis) for axis in mesh.positions[border[:, 0]].T]
    middles = np.stack(sums, axis=-1) / np.bincount(holes)[:, None]
    fans = np.column_stack([border[:, 1], border[:, 0], count + holes])
    return clean(
        TriangleMesh(
            positions=np.concatenate([mesh.positions, middles]),
            faces=np.concatenate([mesh.faces, fans]),
        )
    )


_CELLS = 128
"""Cells along the unit box."""

_MARGIN = 4
"""Cells between the unit box and the border of the grid, which is outside."""

_KEPT_DISTANCE = 0.25
"""Distance of the new surface in cells: a plate is half a cell thick, 0.4 % of the box."""

_CLEARANCE = 0.05
"""Least distance in cells between the surface and a node: no two vertices weld."""

_COARSE = 8
"""Cells of the finest grid in one of the coarsest, where the search for near nodes begins."""

_CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))
_TETRAHEDRA = np.array(
    [np.cumsum([0, *order]) for order in itertools.permutations((4, 2, 1))], np.int64
)
"""[6, 4] rows of `_CORNERS`: neighboring cubes share the diagonals of their faces."""

_CUT_EDGES = {
    1: ((0, 1, 0, 2, 0, 3),),
    2: ((0, 2, 0, 3, 1, 3), (0, 2, 1, 3, 1, 2)),
    3: ((0, 3, 1, 3, 2, 3),),
}
"""Triangles that separate the first N nodes of a tetrahedron from the others: three cut edges."""


def surface_around(mesh: TriangleMesh, *, fills: bool) -> TriangleMesh:
    """Return a closed, oriented, manifold surface around a clean mesh; `fills` its cavities."""
    nodes, distances = _near_nodes(mesh, _CELLS + 2 * _MARGIN + 1)
    level = np.full((_CELLS + 2 * _MARGIN + 1,) * 3, np.inf)
    level[tuple(nodes.T)] = distances - 1
    level = np.where(level < 0, np.minimum(level, -_CLEARANCE), np.maximum(level, _CLEARANCE))
    regions = label(level > 0, np.ones((3, 3, 3)))[0]
    outside = regions == regions[0, 0, 0] if fills else regions > 0
    surface = _march(level, outside)
    _, _, nearest = igl.point_mesh_squared_distance(surface.positions, mesh.positions, mesh.faces)
    pulled = nearest + _KEPT_DISTANCE * (surface.positions - nearest)
    return clean(TriangleMesh(positions=pulled, faces=surface.faces))


def _near_nodes(mesh: TriangleMesh, size: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return nodes [N, 3] with their distances [N] from the mesh in cells.

    They include every corner of a cube that the surface at a distance of one cell crosses.
    """
    tree = igl.AABB()
    tree.init(mesh.positions, mesh.faces)
    spacing = _COARSE
    nodes = np.indices((-(-size // spacing),) * 3).reshape(3, -1).T * spacing
    while True:
        squared = tree.squared_distance(mesh.positions, mesh.faces, _positions(nodes))[0]
        distances = np.sqrt(squared) * _CELLS
        near = distances <= 1 + spacing * np.sqrt(3)  # of the node, or of one of its block
        nodes = nodes[near]
        if spacing == 1:
            return nodes, distances[near]
        spacing //= 2
        nodes = (nodes[:, None] + spacing * _CORNERS).reshape(-1, 3)
        nodes = nodes[(nodes < size).all(axis=1)]


def _positions(nodes: NDArray) -> NDArray[np.float64]:
    """Return the positions [N, 3] in the unit box of nodes of the grid."""
    return (nodes - _MARGIN) / _CELLS - 0.5


def _march(level: NDArray[np.float64], outside: NDArray[np.bool_]) -> TriangleMesh:
    """Return the surface between nodes of negative `level` [S, S, S] and those `outside`."""
    size = level.shape
    meets = [maximum_filter(each, 2, origin=-1) for each in (level < 0, outside)]
    cubes = np.argwhere((meets[0] & meets[1])[:-1, :-1, :-1])
    corners = np.ravel_multi_index(tuple((cubes[:, None] + _CORNERS).transpose(2, 0, 1)), size)
    tetrahedra = corners[:, _TETRAHEDRA].reshape(-1, 4)
    values = level.ravel()
    order = np.argsort(values[tetrahedra] > 0, axis=1, kind="stable")
    ordered = np.take_along_axis(tetrahedra, order, axis=1)
    number = (values[tetrahedra] < 0).sum(axis=1)
    cuts = np.concatenate(
        [ordered[number == n][:, ends] for n, rows in _CUT_EDGES.items() for ends in rows]
    )
    edges, faces = np.unique(cuts.reshape(-1, 2), axis=0, return_inverse=True)
    low, high = (np.column_stack(np.unravel_index(nodes, size)) for nodes in edges.T)
    inner, outer = values[edges].T
    positions = _positions(low + (inner / (inner - outer))[:, None] * (high - low))
    faces = faces.reshape(-1, 3)
    flat = TriangleMesh(positions=positions, faces=faces)
    # a triangle cuts a tetrahedron in two: any of its cut edges says which side is outside
    outward = (high - low)[faces[:, 0]]
    turned = np.einsum("ij,ij->i", flat.double_area_vectors, outward) < 0
    faces = np.where(turned[:, None], faces[:, [0, 2, 1]], faces)
    return TriangleMesh(positions=positions, faces=faces)
