"""Converts the parameters of a flow run (from Prefect's forms) to dataset options."""

from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

from pipeline.flows.forms import (
    BuildChanges,
    BuildName,
    PublicPlace,
    PublicUrl,
    changed_values,
)
from pipeline.generation.dataset_order import DatasetOrder
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
"""Types of parameters that are narrower in a form than in the options."""


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
    """Return the dataset options of a flow's parameters.

    Raises:
        TrilightError: an invalid value that the form's schema cannot detect; the message names it.
    """
    return order_of(parameters, DatasetOrder)


def dataset_in_runs(parameters: Mapping[str, Any]) -> DatasetInRuns:
    """Return the options of a dataset in several flow runs; raises as `dataset_order`."""
    return order_of(parameters, DatasetInRuns)


def order_of(parameters: Mapping[str, Any], kind: type[Order]) -> Order:
    """Return the options of a class that a flow's parameters state; raises as `dataset_order`."""
    values = {name: parameters[name] for name in kind.__dataclass_fields__}
    values["allow_licences"] = tuple(values["allow_licences"])
    values["changes"] = changed_values(values["changes"])
    return kind(**values)


def run_name() -> str:
    """Return the name of the starting flow run: build, number of scenes and output folder."""
    from prefect.runtime import flow_run

    parameters = {"build": DatasetOrder.build, **flow_run.parameters}
    parts = (parameters["build"], parameters.get("scenes"), parameters.get("out"))
    return "-".join(str(part) for part in parts if part is not None)
