"""Surfaces as grids of vertices: a torus, a sphere with two poles, and an open sheet.

Families move the vertices of such grids, so closed surfaces are closed by construction.
"""

import numpy as np
from numpy.typing import NDArray

Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]
"""Positions [V, 3] and faces [F, 3], counter-clockwise from outside."""


def torus_faces(rows: int, columns: int) -> NDArray[np.int64]:
    """Return the 2 rows columns faces of a grid [rows, columns] that is periodic both ways.

    The faces point to the side from which rows run upwards and columns to the left.
    """
    row, column = np.divmod(np.arange(rows * columns), columns)
    next_row = (row + 1) % rows
    next_column = (column + 1) % columns
    corners = np.stack(
        [
            row * columns + column,
            next_row * columns + column,
            next_row * columns + next_column,
            row * columns + next_column,
        ],
        axis=1,
    )
    return corners[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def sphere_faces(rings: int, columns: int) -> NDArray[np.int64]:
    """Return the 2 rings columns faces of rings [rings, columns] between two poles.

    The first pole is vertex rings * columns, the last one follows it. The faces point to the side
    from which rings run upwards and columns to the right: outwards, for columns counter-clockwise
    from above.
    """
    body = torus_faces(rings, columns)[: 2 * (rings - 1) * columns]
    column = np.arange(columns)
    next_column = (column + 1) % columns
    first = rings * columns
    last = rings * columns + 1
    start = (rings - 1) * columns
    bottom = np.stack([np.full(columns, first), column, next_column], axis=1)
    top = np.stack([np.full(columns, last), start + next_column, start + column], axis=1)
    return np.concatenate([bottom, body, top])[:, ::-1]


def sheet_faces(rows: int, columns: int) -> NDArray[np.int64]:
    """Return the 2 (rows - 1) (columns - 1) faces of an open grid [rows, columns].

    The faces point to the side from which rows run upwards and columns to the right.
    """
    row, column = np.divmod(np.arange((rows - 1) * (columns - 1)), columns - 1)
    start = row * columns + column
    corners = np.stack([start, start + 1, start + columns + 1, start + columns], axis=1)
    return corners[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
