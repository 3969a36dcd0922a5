"""Lattices of square bars: frames, crates, towers, cages and grilles.

Thin parts, right angles and many holes; the surface is one piece, whatever its genus.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.objects.builtin.solids import Mesh, taper_and_twist


class _Lattice:
    """Shape of a random lattice."""

    def __init__(self, rng: np.random.Generator) -> None:
        kind = str(rng.choice(["frame", "crate", "tower", "cage", "grille"]))
        low, high = {
            "frame": ((2, 1, 1), (3, 2, 2)),
            "crate": ((3, 3, 2), (5, 4, 3)),
            "tower": ((1, 1, 5), (2, 2, 7)),
            "cage": ((2, 2, 3), (4, 3, 3)),
            "grille": ((5, 0, 3), (8, 0, 5)),
        }[kind]
        # holes along x, y and z; 0 is a grille, one bar thick that way
        self.cells = [int(rng.integers(a, b + 1)) for a, b in zip(low, high, strict=True)]
        self.half_sizes = rng.uniform(0.6, 1.0, 3)  # half extents, before it is warped
        if kind == "tower":
            self.half_sizes *= [0.4, 0.4, 1.3]
        if kind == "grille":
            self.half_sizes *= [1.0, 0.06, 1.0]
        taper = rng.uniform(-0.75, 0.0) if kind == "tower" or rng.random() < 0.5 else 0.0
        bend = float(rng.choice([0.0, rng.uniform(1.0, 3.5)])) if kind == "grille" else 0.0
        # Holes cannot be decimated away: a lattice of many bars has no triangles to spare.
        fine = np.prod(np.add(self.cells, 1)) <= 40 and (kind in ("frame", "tower") or bend > 0)
        self.splits = 2 if fine else 1  # pieces of a bar between two crossings; more bend better
        self.bar = rng.uniform(0.14, 0.36)  # thickness of a bar, in steps of the lattice
        self.hollow = kind in ("crate", "tower", "cage")  # True for bars on the outside only
        self.crate = kind == "crate"  # the lowest layer is a plate and the highest a mere rim
        # from 0, a box, to 1, a ball
        self.roundness = rng.uniform(0.6, 1.0) if kind == "cage" else 0.0
        self.taper = taper if kind in ("tower", "frame") else 0.0
        self.twist_rad = rng.uniform(-0.7, 0.7) if kind == "tower" else 0.0
        self.bend_rad = bend  # angle of the arc about z that x is laid along; 0 is straight


def sample_lattice(rng: np.random.Generator) -> Mesh:
    """Return a random lattice: a closed surface of about 10 splits triangles per bar."""
    params = _Lattice(rng)
    planes, bars = zip(*(_steps(cells, params) for cells in params.cells), strict=True)
    x, y, z = np.meshgrid(*bars, indexing="ij")
    solid = x.astype(np.int64) + y + z >= 2
    if params.hollow:
        outside = np.zeros(solid.shape, bool)
        for axis in range(3):
            edge = np.moveaxis(outside, axis, 0)
            edge[[0, -1]] = True
        solid &= outside
    if params.crate:
        solid[:, :, 0] = True
        solid[1:-1, 1:-1, -1] = False
    corner, faces = _surface(solid)
    unit = np.stack([np.array(planes[axis])[corner[:, axis]] for axis in range(3)], axis=1)
    return _warp(unit, params), faces


def _steps(cells: int, params: _Lattice) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the positions of grid planes [N + 1] from -1 to 1, and which steps [N] are bars."""
    gap = [(1 - params.bar) / params.splits] * params.splits
    widths = np.array([params.bar] + [*gap, params.bar] * cells)
    bars = np.array([True] + ([False] * params.splits + [True]) * cells)
    planes = np.concatenate([[0.0], np.cumsum(widths)])
    return 2 * planes / planes[-1] - 1, bars


def _surface(solid: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the grid points [V, 3] and the faces between solid and empty cells.

    Cells that share only an edge would give that edge four faces; bars that meet at crossings never
    do.
    """
    padded = np.pad(solid, 1).astype(np.int64)
    shape = tuple(size + 1 for size in solid.shape)
    quads = []
    for axis in range(3):
        b = (axis + 1) % 3
        c = (axis + 2) % 3
        change = np.diff(padded, axis=axis)
        for sign in (1, -1):
            # A cell begins where occupancy rises: its face looks down the axis.
            base = np.argwhere(change == sign)
            base[:, [b, c]] -= 1
            steps = [np.zeros(3, np.int64) for _ in range(4)]
            for number in (1, 2):
                steps[number][c if sign > 0 else b] = 1
            for number in (2, 3):
                steps[number][b if sign > 0 else c] = 1
            corners = base[:, None] + np.array(steps)[None]
            quads.append(np.ravel_multi_index(tuple(np.moveaxis(corners, -1, 0)), shape))
    used, flat = np.unique(np.concatenate(quads), return_inverse=True)
    points = np.stack(np.unravel_index(used, shape), axis=1)
    return points, flat.reshape(-1, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def _warp(unit: NDArray[np.float64], params: _Lattice) -> NDArray[np.float64]:
    """Round, scale, taper, twist and bend points [V, 3] of the cube from -1 to 1."""
    largest = np.abs(unit).max(axis=1, keepdims=True)
    length = np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-12)
    ball = unit * largest / length
    points = (unit + params.roundness * (ball - unit)) * params.half_sizes
    taper_and_twist(points, unit[:, 2], params.taper, params.twist_rad)
    if params.bend_rad:
        radius = 2 * params.half_sizes[0] / params.bend_rad
        arc_angle = points[:, 0] / radius
        x = radius - points[:, 1]
        points[:, 0] = x * np.sin(arc_angle)
        points[:, 1] = radius - x * np.cos(arc_angle)
    return points
