"""Draws values of material columns that declare a draw (storage.records.material)."""

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError
from storage.records.material import EMISSION, laid_out
from storage.seeds import SceneKey


def with_drawn_columns(materials: NDArray[np.float32], scene_key: SceneKey) -> NDArray[np.float32]:
    """Return the material rows of a scene with values for the columns that have a draw.

    Each column has a random stream of its own, so that it changes no other draw of the scene. Rows
    that emit keep the default.

    Args:
        materials: rows with all declared columns, which stay unchanged.
        scene_key: seed, index and attempt of the scene.

    Raises:
        TrilightError: a draw returns another shape, or a value outside of its column's range.
    """
    drawn = materials.copy()
    reflects = (materials[:, EMISSION] == 0).all(axis=1)
    for column, part in laid_out():
        if column.draw is None:
            continue
        rng = scene_key.rng(f"material column {column.name}")
        values = np.asarray(column.draw(rng, int(reflects.sum())), np.float32)
        shape = (int(reflects.sum()), column.width)
        if values.shape != shape or not np.all(column.within.holds(values)):
            raise TrilightError(
                f"material column {column.name!r}: its draw returned shape {values.shape}; "
                f"expected {shape}, with every number {column.within}."
            )
        drawn[reflects, part] = values
    return drawn
