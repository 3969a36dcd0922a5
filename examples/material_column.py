"""A material column of your own: the weight of a clear coat on each surface.

    trilight generate tiny --extend material_column.py --scenes 8 --out data/coated
    trilight train tiny --extend material_column.py --set model=coated --data data/coated

Scenes, shards, streams, symmetries, networks and USD carry the column; what a file of another form
cannot hold is named when one is converted. The path tracer reads the four published columns alone,
and says so: pictures that show a coat need a kernel that knows it.
"""

import dataclasses

import numpy as np

from trilight.extend import COLUMNS, SIZES, MaterialColumn, ModelConfig, Within


def sample_coat(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return the coats of the materials of a scene: none on half of them."""
    return np.where(rng.random((count, 1)) < 0.5, 0.0, rng.uniform(0.1, 1.0, (count, 1)))


COLUMNS.register(
    "coat",
    MaterialColumn(
        name="coat",
        means="Weight of a clear coat over the other lobes.",
        width=1,
        within=Within(0, 1),
        draw=sample_coat,  # without it, composed scenes hold the default, which is 0
    ),
)


def coated() -> ModelConfig:
    """Return the smallest network, which reads the coat beside the published columns."""
    return dataclasses.replace(SIZES["smoke"](), material_columns=tuple(COLUMNS))


SIZES.register("coated", coated)
