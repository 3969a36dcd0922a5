"""Grids of vertices, and closed components of objects: lathed bodies, tubes, beams and balls.

Families move the vertices of a torus, of a sphere with two poles, or of an open sheet, so closed
surfaces are closed by construction.

Components of one object may reach into each other, as the leg of a table into its top. They must
not share a plane there: coincident faces have no visible front.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]
"""Positions [V, 3] and faces [F, 3], counter-clockwise from outside."""


def torus_faces(rows: int, columns: int) -> NDArray[np.int64]:
    """Return the 2 rows columns faces of a grid [rows, columns] that is periodic both ways.

    The faces point to the side from which rows run upwards and columns to the left.
    """
    grid = np.arange(rows * columns).reshape(rows, columns)
    above = np.roll(grid, -1, axis=0)
    corners = [grid, above, np.roll(above, -1, axis=1), np.roll(grid, -1, axis=1)]
    return np.stack(corners, axis=-1)[..., [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def sphere_faces(rings: int, columns: int) -> NDArray[np.int64]:
    """Return the 2 rings columns faces of rings [rings, columns] between two poles.

    The first pole is vertex rings * columns, the last one follows it. The faces point to the side
    from which rings run upwards and columns to the right: outwards, for columns counter-clockwise
    from above.
    """
    body = torus_faces(rings, columns)[: 2 * (rings - 1) * columns]
    ring = np.arange(columns)
    shifted = np.roll(ring, -1)
    first = rings * columns
    start = first - columns
    bottom = np.stack([np.full(columns, first), ring, shifted], axis=1)
    top = np.stack([np.full(columns, first + 1), start + shifted, start + ring], axis=1)
    return np.concatenate([bottom, body, top])[:, ::-1]


def sheet_faces(rows: int, columns: int) -> NDArray[np.int64]:
    """Return the 2 (rows - 1) (columns - 1) faces of an open grid [rows, columns].

    The faces point to the side from which rows run upwards and columns to the right.
    """
    grid = np.arange(rows * columns).reshape(rows, columns)
    corners = [grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]]
    return np.stack(corners, axis=-1)[..., [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def join(parts: Sequence[Mesh]) -> Mesh:
    """Return one mesh of all components; no vertices are welded."""
    starts = np.cumsum([0] + [len(positions) for positions, _ in parts])
    faces = [part[1] + start for part, start in zip(parts, starts, strict=False)]
    return np.concatenate([positions for positions, _ in parts]), np.concatenate(faces)


def taper_and_twist(
    points: NDArray[np.float64], level: NDArray[np.float64], taper: float, twist_rad: float
) -> None:
    """Widen points [V, 3] and turn them about z, in place.

    Args:
        points: to be changed.
        level: [V] height of each point, from -1 to 1.
        taper: relative growth of width from the middle to the top, in (-1, 1).
        twist_rad: turn from the middle to the top.
    """
    x, y = (points[:, :2] * (1 + taper * level[:, None])).T
    angle = twist_rad * level
    points[:, 0] = np.cos(angle) * x - np.sin(angle) * y
    points[:, 1] = np.sin(angle) * x + np.cos(angle) * y


def lathe(outline: Sequence[tuple[float, float]], columns: int) -> Mesh:
    """Return a solid of revolution about z, of 2 len(outline) columns triangles.

    Args:
        outline: radius (positive) and height of each ring; flat disks close the ends. The outline
            of a body around the axis runs from the bottom to the top.
        columns: vertices of a ring.
    """
    rings = np.array(outline)
    azimuth = 2 * np.pi * np.arange(columns) / columns
    flat = rings[:, :1, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)[None]
    grid = np.concatenate(
        [flat, np.broadcast_to(rings[:, 1:, None], (*flat.shape[:2], 1))], axis=2
    ).reshape(-1, 3)
    poles = [[0.0, 0.0, rings[0, 1]], [0.0, 0.0, rings[-1, 1]]]
    return np.concatenate([grid, poles]), sphere_faces(len(rings), columns)


def tube(path: NDArray[np.float64], radii: NDArray[np.float64], sides: int) -> Mesh:
    """Return a closed tube along `path` [N, 3] with `radii` [N], of 2 N sides triangles.

    The tube folds where a bend is narrower than its thickness.
    """
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.zeros_like(path)
    # Start from the axis farthest from the first tangent; transport it along without rotation.
    last = np.eye(3)[np.abs(tangent[0]).argmin()]
    for index, direction in enumerate(tangent):
        last = last - direction * (last @ direction)
        last = last / np.linalg.norm(last)
        side[index] = last
    up = np.cross(tangent, side)
    azimuth = 2 * np.pi * np.arange(sides) / sides
    ring = (
        np.cos(azimuth)[None, :, None] * side[:, None]
        + np.sin(azimuth)[None, :, None] * up[:, None]
    )
    grid = (path[:, None] + radii[:, None, None] * ring).reshape(-1, 3)
    return np.concatenate([grid, path[[0, -1]]]), sphere_faces(len(path), sides)


def box(centre: ArrayLike, half_sizes: ArrayLike, chamfer: float) -> Mesh:
    """Return an upright box with beveled edges, of 44 triangles.

    `chamfer` is how far edges are cut back: more than 0, less than every half size.
    """
    half = np.asarray(half_sizes, np.float64)
    corners = _SIGNS[:, None, :] * (half - chamfer * (1 - np.eye(3)))[None]
    return corners.reshape(-1, 3) + np.asarray(centre), _BOX_FACES


def beam(
    start: ArrayLike, end: ArrayLike, sizes: tuple[float, float], chamfer: float, taper: float = 1.0
) -> Mesh:
    """Return a beveled bar of 44 triangles between two points that are not above each other in y.

    Args:
        start: middle of one end.
        end: middle of the other end.
        sizes: half widths, across (level or along x) and at right angles to that.
        chamfer: as in `box`.
        taper: width at the end over the width at the start.
    """
    first = np.asarray(start, np.float64)
    last = np.asarray(end, np.float64)
    length = float(np.linalg.norm(last - first))
    axis = (last - first) / length
    upright = np.array([0.0, 0.0, 1.0]) if abs(axis[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    across = np.cross(upright, axis)
    across /= np.linalg.norm(across)
    local, faces = box([0.0, 0.0, 0.0], [*sizes, length / 2], chamfer)
    width = 1 + (taper - 1) * (local[:, 2:] / length + 0.5)
    local[:, :2] *= width
    frame = np.stack([across, np.cross(axis, across), axis])
    return local @ frame + (first + last) / 2, faces


def icosphere(frequency: int) -> Mesh:
    """Return the unit sphere of 20 frequency^2 even triangles."""
    golden = (1 + np.sqrt(5)) / 2
    flat = np.array([[0.0, a, b * golden] for a in (-1, 1) for b in (-1, 1)])
    corners = np.concatenate([np.roll(flat, shift, axis=1) for shift in range(3)])
    distance = np.linalg.norm(corners[:, None] - corners[None], axis=2)
    near = np.abs(distance - 2) < 1e-9
    sides = np.array(
        [(i, j, k) for i in range(12) for j in range(i) for k in range(j)
         if near[i, j] and near[j, k] and near[i, k]]
    )  # fmt: skip
    steps = np.array(
        [(i, j) for i in range(frequency + 1) for j in range(frequency + 1 - i)], np.int64
    )
    number = {(int(i), int(j)): index for index, (i, j) in enumerate(steps)}
    cells = [((i, j), (i + 1, j), (i, j + 1)) for i, j in number if i + j < frequency]
    cells += [((i + 1, j), (i + 1, j + 1), (i, j + 1)) for i, j in number if i + j < frequency - 1]
    local = np.array([[number[corner] for corner in cell] for cell in cells])
    weights = np.column_stack([steps, frequency - steps.sum(axis=1)]) / frequency
    points = np.einsum("ns,fsd->fnd", weights, corners[sides]).reshape(-1, 3)
    faces = (local[None] + len(steps) * np.arange(20)[:, None, None]).reshape(-1, 3)
    _, first, same = np.unique(
        np.rint(points * 1e6), axis=0, return_index=True, return_inverse=True
    )
    points = points[first] / np.linalg.norm(points[first], axis=1, keepdims=True)
    return points, outward(points, same.reshape(-1)[faces])


def outward(positions: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Orient the faces of a body that is star-shaped about the origin outwards."""
    a, b, c = positions[faces].transpose(1, 0, 2)
    inside_out = np.einsum("ij,ij->i", np.cross(b - a, c - a), a + b + c) < 0
    return np.where(inside_out[:, None], faces[:, ::-1], faces)


_SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
"""Corners of a box; vertex 3 i + a is that of corner i on the side across axis a."""


def _box_faces() -> NDArray[np.int64]:
    """Return six sides, twelve bevels and eight corners, as triangles."""
    quads = []
    steps = (4, 2, 1)
    for axis in range(3):
        u, v = (step for other, step in enumerate(steps) if other != axis)
        b, c = (other for other in range(3) if other != axis)
        lows = (0, steps[axis])
        quads += [[3 * (low + add) + axis for add in (0, u, u + v, v)] for low in lows]
        for low in (0, u, v, u + v):
            high = low + steps[axis]
            quads.append([3 * low + b, 3 * high + b, 3 * high + c, 3 * low + c])
    sides = np.array(quads, np.int64)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    unit = (_SIGNS[:, None, :] * (1 - 0.25 * (1 - np.eye(3)))[None]).reshape(-1, 3)
    return outward(unit, np.concatenate([np.arange(24).reshape(8, 3), sides]))


_BOX_FACES = _box_faces()
