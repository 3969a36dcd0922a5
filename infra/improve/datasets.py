"""The dataset of a round, and what its scenes cost by stratum."""

import dataclasses
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path

from infra.improve.order import ImproveOrder
from infra.improve.state import Drawn
from pipeline.making.dataset_order import DatasetOrder
from scene_templates.strata import Stratum, stratum_of
from storage.dataset.layout import DatasetFolder
from storage.dataset.scene_logs import read_scene_logs
from storage.errors import TrilightError
from storage.settings.described import settings_record

_FIRST_SHARDS = 6
"""Shards of the first dataset: the third is for validation and the sixth for testing."""


def weighed_strata(
    order: ImproveOrder, drawn: Drawn, history: Sequence[Drawn]
) -> tuple[Stratum, ...]:
    """Return the strata of a round's build: its weights, and those of the rounds before it."""
    return tuple(
        dataclasses.replace(
            stratum,
            weight=drawn.weights[stratum.name],
            earlier_weights=tuple(earlier.weights[stratum.name] for earlier in history),
        )
        for stratum in order.strata()
    )


def dataset_order(
    order: ImproveOrder, drawn: Drawn, history: Sequence[Drawn], place: Path
) -> DatasetOrder:
    """Return the order of a round's dataset, whose manifest then holds the weights' history.

    The first round has all splits, later ones scenes for training alone.
    """
    shards, trained = (2, 2) if history else (_FIRST_SHARDS, 4)
    scenes_per_shard = -(-drawn.scenes // trained)
    strata = weighed_strata(order, drawn, history)
    changes = {
        **order.changes,
        "splits.scenes_per_shard": scenes_per_shard,
        "scenes.strata": [settings_record(stratum) for stratum in strata],
    }
    return DatasetOrder(
        build=order.build,
        objects=order.objects,
        out=str(place),
        scenes=shards * scenes_per_shard,
        seed=drawn.seed,
        changes=changes,
    )


def scene_costs(places: Mapping[Path, Sequence[Stratum]]) -> dict[str, float]:
    """Return the median core-seconds of making a scene of each stratum, over some datasets.

    The median, since the first scene of a process waits for its libraries.

    Args:
        places: folders of datasets, with the strata of their builds.

    Raises:
        TrilightError: there is no log of any scene.
    """
    found: dict[str, list[float]] = {}
    for place, strata in places.items():
        for row in read_scene_logs(DatasetFolder(place)):
            if row.scene_index is not None:
                name = stratum_of(strata, row.scene_index).name
                found.setdefault(name, []).append(max(row.seconds * row.cores, 1e-3))
    if not found:
        raise TrilightError(
            f"improve: the logs of {', '.join(map(str, places))} hold no scene; expected the cost "
            "of each. Delete the last round's folder to make it anew."
        )
    whole = statistics.median(cost for costs in found.values() for cost in costs)
    names = {stratum.name for strata in places.values() for stratum in strata}
    return {name: statistics.median(found.get(name, [whole])) for name in sorted(names)}


def making_core_s(place: Path) -> float:
    """Return the core-seconds of making a dataset, as its logs say."""
    return sum(row.seconds * row.cores for row in read_scene_logs(DatasetFolder(place)))
