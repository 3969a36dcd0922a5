"""A material column that is declared from outside, for as long as a test runs."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from numpy.typing import NDArray

from storage.records import material
from storage.records.material import COLUMNS, PUBLISHED_COLUMNS, MaterialColumn
from storage.registry import Registry
from storage.settings.ranges import Within

WITH_COAT = (*PUBLISHED_COLUMNS, "coat")


def sample_coat(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    return rng.uniform(0.1, 0.9, (count, 1))


COAT = MaterialColumn(
    name="coat", means="Weight of a clear coat.", width=1, within=Within(0, 1), draw=sample_coat
)
TINT = MaterialColumn(
    name="tint",
    means="Colour of light that the material gives away, for the laws of colours and of radiance.",
    width=3,
    within=Within(0, 1000),
    is_colour=True,
    is_radiance=True,
)
WAVES = MaterialColumn(
    name="waves", means="Five numbers.", width=5, within=Within(-1, 1), default=0.5
)


@contextmanager
def declared(*columns: MaterialColumn) -> Iterator[None]:
    """Let these columns be declared beside the published ones, and no others; undo it."""
    beside = {name: COLUMNS[name] for name in PUBLISHED_COLUMNS}
    beside |= {column.name: column for column in columns}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(material, "COLUMNS", Registry("material column", MaterialColumn, beside))
        yield
