"""Converts the parameters of a flow run (from Prefect's forms) to orders."""

from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

from pipeline.flows.forms import (
    BuildChanges,
    BuildName,
    PublicPlace,
    PublicUrl,
    changed_values,
)
from pipeline.making.dataset_order import DatasetOrder
from storage.dataset.shard_places import MAX_SHARDS
from storage.errors import TrilightError
from storage.settings.described import checked
from storage.settings.ranges import Within

Order = TypeVar("Order", bound=DatasetOrder)

DATASET_FORMS: Mapping[str, Any] = {
    "build": BuildName,
    "objects": PublicUrl | None,
    "out": PublicPlace | None,
    "changes": BuildChanges | None,
}
"""Types of parameters that are narrower in a form than in an order."""


@checked()
class DatasetInRuns(DatasetOrder):
    """A dataset made by several flow runs, each of which makes a range of the shards."""

    flow_runs: Annotated[int, Within(1, MAX_SHARDS, unit="flow runs")] = 1
    """Total number of flow runs: this one, and one run of the deployment for each other range."""
    deployment: str = "generate-scenes/local"
    """Deployment that makes the other ranges, as FLOW/DEPLOYMENT."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shards is not None:
            raise TrilightError(
                f"shards is {self.shards!r}; expected no range, since the whole dataset is made. "
                "Run generate-scenes for a range."
            )


def dataset_order(parameters: Mapping[str, Any]) -> DatasetOrder:
    """Return the order that a flow's parameters state.

    Raises:
        TrilightError: a value that no schema can refuse; the message names it.
    """
    return order_of(parameters, DatasetOrder)


def dataset_in_runs(parameters: Mapping[str, Any]) -> DatasetInRuns:
    """Return the order in several runs that a flow's parameters state; raises as above."""
    return order_of(parameters, DatasetInRuns)


def order_of(parameters: Mapping[str, Any], kind: type[Order]) -> Order:
    """Return the order of a kind that a flow's parameters state; raises as above."""
    values = {name: parameters[name] for name in kind.__dataclass_fields__}
    values["allow_licences"] = tuple(values["allow_licences"])
    values["changes"] = changed_values(values["changes"])
    return kind(**values)


def run_name() -> str:
    """Return what the flow run that begins is called: what is made of what, and where."""
    from prefect.runtime import flow_run

    given = {"build": DatasetOrder.build, **flow_run.parameters}
    parts = (given["build"], given.get("scenes"), given.get("out"))
    return "-".join(str(part) for part in parts if part is not None)
