"""Path guiding inside a kernel: directions from which light reaches a cell by way of a mirror.

A row of the table is a histogram over the sphere of directions, of whole numbers that add up to
ENTRIES. One load draws a bin, and another gives its density, which is exact: the picture is
unbiased whatever the table says. Bins are squares of the octahedral map (Engelhardt and Dachsbacher
2008), which takes no trigonometry. Cells that have learnt nothing have row 0.

The path tracer draws a share of its directions from the table and the others by the BRDF. The
density of this mixture is the c_i of pipeline.renders.light_kernel for i > 1. At x1 the path tracer
is not guided: light paths land there, and guiding there too made pictures no better (study S18).
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.device_memory import own_floats, own_integers
from pipeline.renders.ggx import KernelLobes
from pipeline.renders.guide_cells import GuideCells

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
        self._bins = own_integers(np.concatenate([np.zeros(ENTRIES, np.int64), bins]))
        self._densities = own_floats(on_square)

    def at(
        self, triangle: Any, barycentric: Any, front: Any, lobes: KernelLobes, active: Any
    ) -> Guidance:
        """Return what guides a path; `lobes` are those that its viewer sees."""
        cell = self._cells.index(triangle, barycentric, front, active)
        row = dr.gather(mi.UInt32, self._row_of_cell, cell, active)
        rough = rough_share(lobes)
        return Guidance(row=row, share=dr.select(row > 0, _SHARE * rough, 0))

    def pdf(self, guidance: Guidance, direction: Any, active: Any) -> Any:
        """Return the density (Float, per steradian) with which `sample` draws a unit Vector3f."""
        index, length = bin_of(direction)
        learnt = active & (guidance.row > 0)
        on_square = dr.gather(mi.Float, self._densities, guidance.row * BINS + index, learnt)
        return on_square / (length * dr.square(length))

    def mixture(self, guidance: Guidance, unguided: Any, direction: Any, active: Any) -> Any:
        """Return the density of a path's direction from that of its BRDF sample alone."""
        learnt = self.pdf(guidance, direction, active)
        return dr.fma(learnt - unguided, guidance.share, unguided)

    def sample(self, guidance: Guidance, u: Any, active: Any) -> Any:
        """Return a unit direction (Vector3f) in world space from a uniform Point2f."""
        scaled = u.x * ENTRIES
        entry = dr.minimum(mi.UInt32(scaled), ENTRIES - 1)
        index = dr.gather(mi.UInt32, self._bins, guidance.row * ENTRIES + entry, active)
        line = index // SIDE
        x = mi.Float(index - line * SIDE) + (scaled - mi.Float(entry))
        return _from_square(x * (2 / SIDE) - 1, (mi.Float(line) + u.y) * (2 / SIDE) - 1)


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
