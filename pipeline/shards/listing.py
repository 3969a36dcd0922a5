"""The scenes of a finished dataset that a selection takes, with what decides about most."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any

import numpy as np

from pipeline.shards.finished import FinishedDataset
from pipeline.shards.plans import Selection, taken_scenes
from storage.records.quantities import QUANTITIES

_TEXTS = ("split", "template")
_SHOWN = {
    "triangles_per_scene": ("triangles", np.min),
    "lights_per_scene": ("lights", np.min),
    "coverage": ("coverage", np.min),
    "noise_floor_db": ("floor", np.min),
    "noise_floor_linear_db": ("linear", np.min),
    "spp": ("spp", np.max),
}
"""Quantities, what their columns are called, and which of several values is shown."""


@dataclass(frozen=True, kw_only=True)
class Listed:
    """What a selection takes."""

    rows: Sequence[Mapping[str, object]]
    """A row for each scene, in the order of the shards: column to value."""
    of: int
    """Scenes of the dataset."""


def listed_scenes(
    source: FinishedDataset,
    selection: Selection,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Listed:
    """Return the scenes that a selection takes; none is an answer too.

    Args:
        source: the dataset.
        selection: the conditions.
        progress: called with the shards that are read so far, and with their number.

    Raises:
        TrilightError: a shard is damaged.
    """
    done, total = count(1), len(source.manifest.shards)
    found = taken_scenes(
        [source],
        selection,
        asked=(*_TEXTS, *_SHOWN),
        shard_done=lambda: progress(next(done), total),
    )
    rows = [{"key": entry.key, **_row(entry.facts.values)} for entry in found]
    return Listed(rows=rows, of=source.manifest.num_samples)


def _row(values: Mapping[str, Any]) -> dict[str, object]:
    row: dict[str, object] = {name: values[name] for name in _TEXTS}
    for name, (column, of_several) in _SHOWN.items():
        number = round(float(of_several(values[name])), QUANTITIES[name].digits)
        row[column] = number if QUANTITIES[name].digits else int(number)
    return row
