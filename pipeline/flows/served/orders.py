"""Flow parameters to orders: the forms of Prefect's page and our own records."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from pipeline.flows.order import DatasetOrder
from pipeline.flows.served.schema import (
    BuildChanges,
    BuildName,
    PublicPlace,
    PublicUrl,
    changed_values,
)
from storage.ranges import Within
from storage.shard_places import MAX_SHARDS

DATASET_FORMS: Mapping[str, Any] = {
    "build": BuildName,
    "objects": PublicUrl | None,
    "out": PublicPlace,
    "changes": BuildChanges | None,
}
"""Types of parameters that are narrower in a form than in an order."""


@dataclass(frozen=True, kw_only=True)
class DatasetInRuns(DatasetOrder):
    """A dataset whose ranges of shards are flow runs of their own, for as many workers."""

    flow_runs: Annotated[int, Within(1, MAX_SHARDS, unit="flow runs")] = 1
    """Ranges that are made as separate runs of the deployment; with 1, everything is made here."""
    deployment: str = "generate-scenes/local"
    """The deployment that makes the ranges, as FLOW/DEPLOYMENT."""


def dataset_order(parameters: Mapping[str, Any]) -> DatasetOrder:
    """Return the order that a flow's parameters state.

    Raises:
        TrilightError: a value that no schema can refuse; the message names it.
    """
    order = {name: parameters[name] for name in DatasetOrder.__dataclass_fields__}
    order["allow_licences"] = tuple(order["allow_licences"])
    order["changes"] = changed_values(order["changes"])
    return DatasetOrder(**order)
