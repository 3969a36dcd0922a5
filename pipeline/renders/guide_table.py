"""Path guiding inside a kernel: directions from which light reaches a cell by way of a mirror.

A row of the table is a histogram over the sphere of directions, of whole numbers that add up to
ENTRIES. One load draws a bin, and another gives its density, which is exact: the picture is
unbiased whatever the table says. Bins are squares of the octahedral map (Engelhardt and Dachsbacher
2008), which takes no trigonometry. Cells that have learnt nothing have row 0.

The table is learnt once for a scene, from photons (after Jensen 1995). Small cells have few of
them. So cells that lie in one cube of space and face the same way share a row, from small cubes to
large ones: a cell takes the smallest that has enough photons, with a part of what the next larger
one says, for what the few have missed.

The path tracer draws a share of its directions from the table and the others by the BRDF. The
density of this mixture is the c_i of pipeline.renders.path_kernel for i > 1. At x1 the path tracer
is not guided: light paths land there, and guiding there too made pictures no better (study S18).
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.device_memory import own_floats, own_integers, read_back
from pipeline.renders.ggx import KernelLobes
from pipeline.renders.surface_table import Hit

if TYPE_CHECKING:
    from pipeline.renders.path_kernel import Arrival

_CELLS = 1500
"""A cell is about as large as so many parts of the scene's whole surface, or smaller."""

_MOST_CUTS = 64
"""Most cells along an edge of a triangle."""


class GuideCells:
    """Cells of triangles, for which directions are learnt: a grid on each of their two sides.

    Not a dataclass: Dr.Jit would take its arrays for loop variables.
    """

    def __init__(self, corners: NDArray[np.float64]) -> None:
        """Cut triangles, [T, 3, 3], into cells."""
        edge1 = corners[:, 1] - corners[:, 0]
        edge2 = corners[:, 2] - corners[:, 0]
        normal = np.cross(edge1, edge2)
        area = 0.5 * np.linalg.norm(normal, axis=1)
        self.size_m = max(float(np.sqrt(area.sum() / _CELLS)), np.finfo(np.float32).tiny)
        """About the width of the largest cells."""
        cuts = np.clip(np.ceil(np.sqrt(area) / self.size_m), 1, _MOST_CUTS).astype(np.int64)
        first = np.cumsum(2 * cuts**2) - 2 * cuts**2
        self._rows = own_integers(np.column_stack([first, cuts]))
        triangle = np.repeat(np.arange(len(cuts)), 2 * cuts**2)
        number = np.arange(len(triangle)) - first[triangle]
        places = number // 2 % cuts[triangle], number // 2 // cuts[triangle]
        u, v = ((place + 0.5) / cuts[triangle] for place in places)
        is_beyond = u + v > 1
        u, v = np.where(is_beyond, (1 - v, 1 - u), (u, v))
        self.centres_m = (
            corners[triangle, 0] + u[:, None] * edge1[triangle] + v[:, None] * edge2[triangle]
        )
        """[C, 3] a point of each cell; of cells beyond the triangle's third edge, one nearby."""
        outward = normal[triangle] * np.where(number % 2 == 1, 1.0, -1.0)[:, None]
        axis = np.abs(outward).argmax(axis=1)
        self.facing = 2 * axis + (outward[np.arange(len(axis)), axis] > 0)
        """[C] 0 to 5: the axis and the sign of the largest component of the normal."""

    def index(self, hit: Hit, front: Any, active: Any) -> Any:
        """Return the cell (UInt32) of a point; `front` says which side of the triangle it is."""
        row = dr.gather(mi.Vector2u, self._rows, hit.triangle, active)
        first = row.x
        cuts = row.y
        column, line = (
            dr.minimum(mi.UInt32(dr.maximum(weight, 0) * mi.Float(cuts)), cuts - 1)
            for weight in hit.barycentric
        )
        return first + 2 * (line * cuts + column) + dr.select(front, mi.UInt32(1), mi.UInt32(0))


SIDE = 32
"""Bins along each side of the square; a bin is 4 to 8 degrees wide."""

BINS = SIDE * SIDE
ENTRIES = BINS
"""Entries of a row: a bin's share is a multiple of 1 / ENTRIES."""

_SHARE = 0.5
"""Share of a rough surface's directions that are drawn from the table."""

_ROUGH_ALPHA = 0.05
"""Least GGX width of a lobe that is guided: a narrower one finds its directions itself."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Guidance:
    """The guide of each path at its vertex, lane by lane."""

    row: Any
    """Row of the guide table, UInt32; 0 is not guided."""
    share: Any
    """Fraction of directions that are drawn from the row, Float."""
    table: "GuideTable"

    def pdf(self, direction: Any, active: Any) -> Any:
        """Return the density (Float, per steradian) with which `sample` draws a unit Vector3f."""
        index, length = bin_of(direction)
        learnt = active & (self.row > 0)
        on_square = dr.gather(mi.Float, self.table.densities, self.row * BINS + index, learnt)
        return on_square / (length * dr.square(length))

    def mixture(self, unguided: Any, direction: Any, active: Any) -> Any:
        """Return the density of a path's direction from that of its BRDF sample alone."""
        learnt = self.pdf(direction, active)
        return dr.fma(learnt - unguided, self.share, unguided)

    def sample(self, u: Any, active: Any) -> Any:
        """Return a unit direction (Vector3f) in world space from a uniform Point2f."""
        scaled = u.x * ENTRIES
        entry = dr.minimum(mi.UInt32(scaled), ENTRIES - 1)
        index = dr.gather(mi.UInt32, self.table.bins, self.row * ENTRIES + entry, active)
        line = index // SIDE
        x = mi.Float(index - line * SIDE) + (scaled - mi.Float(entry))
        return _from_square(x * (2 / SIDE) - 1, (mi.Float(line) + u.y) * (2 / SIDE) - 1)


class GuideTable:
    """The table of a scene. Not a dataclass: Dr.Jit would take its arrays for loop variables."""

    def __init__(
        self, cells: GuideCells, row_of_cell: NDArray[np.int64], counts: NDArray[np.int64]
    ) -> None:
        """Build the table.

        Args:
            cells: of the surfaces.
            row_of_cell: [C] row of each cell; 0 where it has learnt nothing.
            counts: [N, BINS] entries of each bin in the rows 1 to N; each adds up to ENTRIES.
        """
        bins = np.repeat(np.tile(np.arange(BINS), len(counts)), counts.ravel())
        on_square = np.concatenate([np.zeros(BINS), counts.ravel() * (BINS / 4 / ENTRIES)])
        self._cells = cells
        self._row_of_cell = own_integers(row_of_cell)
        self.bins = own_integers(np.concatenate([np.zeros(ENTRIES, np.int64), bins]))
        self.densities = own_floats(on_square)

    def at(self, hit: Hit, front: Any, lobes: KernelLobes, active: Any) -> Guidance:
        """Return what guides a path; `lobes` are those that its viewer sees."""
        cell = self._cells.index(hit, front, active)
        row = dr.gather(mi.UInt32, self._row_of_cell, cell, active)
        rough = rough_share(lobes)
        return Guidance(row=row, share=dr.select(row > 0, _SHARE * rough, 0), table=self)


def rough_share(lobes: KernelLobes) -> Any:
    """Return the share (Float) of a surface's lobes that may be guided."""
    return dr.select(lobes.alpha >= _ROUGH_ALPHA, 1, 1 - lobes.weight)


def bin_of(direction: Any) -> tuple[Any, Any]:
    """Return the bin (UInt32) of a unit direction, and the sum of its absolute components.

    An area on the square [-1, 1]^2 is a solid angle divided by the third power of that sum.
    """
    length = dr.abs(direction.x) + dr.abs(direction.y) + dr.abs(direction.z)
    x = direction.x / length
    y = direction.y / length
    below = direction.z < 0
    folded_x = dr.mulsign(1 - dr.abs(y), x)
    folded_y = dr.mulsign(1 - dr.abs(x), y)
    x = dr.select(below, folded_x, x)
    y = dr.select(below, folded_y, y)
    # A direction of no length is no number, and what that is as an integer is the processor's own:
    # bounded behind the conversion too, it reads within the table, and its light is nothing anyway.
    column, line = (
        dr.minimum(mi.UInt32(dr.clip((v + 1) * (SIDE / 2), 0, SIDE - 1)), SIDE - 1) for v in (x, y)
    )
    return line * SIDE + column, length


def _from_square(x: Any, y: Any) -> Any:
    z = 1 - dr.abs(x) - dr.abs(y)
    fold = dr.maximum(-z, 0)
    return dr.normalize(mi.Vector3f(x - dr.mulsign(fold, x), y - dr.mulsign(fold, y), z))


_LEVELS = 4
"""Sizes of cubes: 1, 2, 4 and 8 times a cell."""

_LEAST_PHOTONS = 64
"""Fewest photons of a row."""

_MOST_ROWS = 2048
"""Most rows of one level, which bounds the table by 64 MB."""

_PARENT = 0.25
"""Part of a row that the next larger cube says."""


_SLOTS = 6
"""Vertices of a path that are recorded at most."""

_NARROW = 1.0
"""Least density (per steradian) of a bounce whose arrival is recorded: thrice that of a cosine."""

_LEAST_ROUGH = 0.2
"""Least share of a surface's lobes that may be guided, for an arrival to be recorded."""


class PhotonRecords:
    """Where light arrives by way of narrow lobes; path guiding learns from it.

    Arrivals straight from an emitter are not recorded, because the path tracer picks emitters, nor
    those by way of wide lobes, because a BRDF sample finds such light. Not a dataclass: Dr.Jit
    would take its arrays for loop variables.
    """

    def __init__(self, cells: GuideCells, count: int) -> None:
        """Begin with none, for `count` paths."""
        self._guide_cells = cells
        self._first = dr.arange(mi.UInt32, count) * _SLOTS
        self._cells = dr.zeros(mi.UInt32, count * _SLOTS)
        self._bins = dr.zeros(mi.UInt32, count * _SLOTS)
        self._powers = dr.zeros(mi.Float, count * _SLOTS)

    def __call__(self, _: Any, arrival: "Arrival") -> None:
        """Record an arrival of each lane in a cell, from the bin of its direction."""
        vertex = arrival.vertex
        cell = self._guide_cells.index(vertex.hit, vertex.front, arrival.active)
        index, _ = bin_of(-arrival.direction)
        reflects = dr.max(vertex.lobes.diffuse + vertex.lobes.specular) > 0
        arrives = arrival.active & (arrival.drawn > _NARROW) & reflects
        arrives &= rough_share(vertex.lobes) > _LEAST_ROUGH
        slot = arrival.depth - 2
        active = arrives & (slot < _SLOTS)
        place = self._first + slot
        dr.scatter(self._cells, cell, place, active)
        dr.scatter(self._bins, index, place, active)
        dr.scatter(self._powers, arrival.power, place, active)

    def photons(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Return cells, bins and powers of all that was recorded, path by path, as for `learn`."""
        powers = read_back(self._powers).astype(np.float64)
        rows = np.flatnonzero((powers > 0) & np.isfinite(powers))
        hit_cells, bins = (read_back(v)[rows].astype(np.int64) for v in (self._cells, self._bins))
        return hit_cells, bins, powers[rows]


def learn(
    cells: GuideCells,
    hit_cells: NDArray[np.int64],
    bins: NDArray[np.int64],
    powers: NDArray[np.float64],
) -> GuideTable | None:
    """Return the guide table, or None if no cell got enough photons.

    Args:
        cells: of the surfaces.
        hit_cells: [P] cell that each photon hit.
        bins: [P] bin of the direction from which each photon came (`bin_of`).
        powers: [P] in any unit, above 0.
    """
    least = max(_LEAST_PHOTONS, math.ceil(len(hit_cells) / _MOST_ROWS))
    row_of_cell = np.zeros(len(cells.facing), np.int64)
    rows = np.zeros((1, BINS))
    for level in reversed(range(_LEVELS)):
        # the number of each cell's cube and facing
        cube = np.floor(cells.centres_m / (cells.size_m * 2**level)).astype(np.int64)
        _, group = np.unique(np.column_stack([cube, cells.facing]), axis=0, return_inverse=True)
        group = group.ravel()
        large_groups = np.flatnonzero(
            np.bincount(group[hit_cells], minlength=group.max() + 1) >= least
        )
        place = np.full(group.max() + 1, -1)
        place[large_groups] = np.arange(len(large_groups))
        row = place[group][hit_cells]
        flat = row[row >= 0] * BINS + bins[row >= 0]
        sums = np.bincount(flat, powers[row >= 0], minlength=len(large_groups) * BINS)
        finer = _shares(sums.astype(np.float64).reshape(-1, SIDE, SIDE))
        parents = np.zeros(len(large_groups), np.int64)
        held = place[group] >= 0
        parents[place[group[held]]] = row_of_cell[held]
        known = (parents > 0)[:, None]
        finer = np.where(known, (1 - _PARENT) * finer + _PARENT * rows[parents], finer)
        row_of_cell = np.where(held, len(rows) + place[group], row_of_cell)
        rows = np.concatenate([rows, finer])
    used, row_of_cell = np.unique(np.append(row_of_cell, 0), return_inverse=True)
    if len(used) == 1:
        return None
    return GuideTable(cells, row_of_cell[:-1], apportion_entries(rows[used[1:]]))


def apportion_entries(shares: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return shares [N, BINS] as whole numbers that add up to ENTRIES; each row of shares to 1."""
    edges = np.rint(np.cumsum(shares, axis=1) * ENTRIES).astype(np.int64)
    return np.diff(edges, axis=1, prepend=0)


def _shares(histograms: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return each histogram blurred over its neighbours, with a sum of 1, [N, BINS]."""
    wide = np.pad(histograms, ((0, 0), (1, 1), (1, 1)), mode="edge")
    wide = wide[:, :-2] + 2 * wide[:, 1:-1] + wide[:, 2:]
    blurred = (wide[:, :, :-2] + 2 * wide[:, :, 1:-1] + wide[:, :, 2:]).reshape(-1, BINS)
    shares: NDArray[np.float64] = blurred / blurred.sum(axis=1, keepdims=True)
    return shares
