"""Lists the scenes of a finished dataset that a selection takes, with their main values."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any

import numpy as np

from pipeline.shards.finished_dataset import FinishedDataset
from pipeline.shards.plans import Selection, select_scenes
from storage.records.quantities import QUANTITIES

_TEXTS = ("split", "template")
_COLUMNS = {
    "triangles_per_scene": ("triangles", np.min),
    "lights_per_scene": ("lights", np.min),
    "coverage": ("coverage", np.min),
    "noise_floor_db": ("floor", np.min),
    "noise_floor_linear_db": ("linear", np.min),
    "spp": ("spp", np.max),
}
"""Quantities with the name of their column, and the function that reduces several values."""


@dataclass(frozen=True, kw_only=True)
class SceneListing:
    """The scenes that a selection takes."""

    rows: Sequence[Mapping[str, object]]
    """One row for each scene, in the order of the shards: column to value."""
    of: int
    """Total number of scenes of the dataset."""


def list_scenes(
    source: FinishedDataset,
    selection: Selection,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> SceneListing:
    """Return the scenes that a selection takes; possibly none.

    Args:
        source: the dataset.
        selection: the conditions.
        progress: called with the number of shards read so far, and the total.

    Raises:
        TrilightError: a shard is damaged.
    """
    done = count(1)
    total = len(source.manifest.shards)
    selected = select_scenes(
        [source],
        selection,
        value_names=(*_TEXTS, *_COLUMNS),
        shard_done=lambda: progress(next(done), total),
    )
    rows = [{"key": entry.key, **_row(entry.facts.values)} for entry in selected]
    return SceneListing(rows=rows, of=source.manifest.num_samples)


def _row(values: Mapping[str, Any]) -> dict[str, object]:
    row: dict[str, object] = {name: values[name] for name in _TEXTS}
    for name, (column, of_several) in _COLUMNS.items():
        number = round(float(of_several(values[name])), QUANTITIES[name].digits)
        row[column] = number if QUANTITIES[name].digits else int(number)
    return row
