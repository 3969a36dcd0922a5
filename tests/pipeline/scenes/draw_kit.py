"""Draws of entries that fit into a budget, as composition draws its objects."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from pipeline.scenes.fitting import FitTable, drawn_rows

Entry = TypeVar("Entry")


def drawn_within(
    rng: np.random.Generator,
    entries: Sequence[Entry],
    least: Sequence[int],
    count: int,
    num_triangles: int,
    camps: Sequence[str] = (),
) -> list[Entry]:
    """Return the entries of the rows that `drawn_rows` draws."""
    rows = drawn_rows(rng, FitTable.of(least, camps), count, num_triangles)
    return [entries[row] for row in rows]
