"""The flow `build-dataset`: objects, then scenes, then the documents, by one worker or by many."""

import dataclasses
import itertools
from typing import Any

from prefect import flow
from prefect.deployments import run_deployment

from pipeline.flows.order import DatasetOrder
from pipeline.flows.served.generate_scenes import generate_scenes
from pipeline.flows.served.orders import DATASET_FORMS, DatasetInRuns
from pipeline.flows.served.prepare_assets import prepare_assets
from pipeline.flows.served.schema import parameters_of
from storage.dataset_status import read_status
from storage.errors import TrilightError


@flow(name="build-dataset", persist_result=False)
@parameters_of(DatasetInRuns, **DATASET_FORMS)
def build_dataset(**parameters: Any) -> None:
    """Make a dataset: its objects, its scenes, its documents; on several workers if asked for.

    The ranges of the others are flow runs of their own. This run takes part in all of them: it
    makes what nobody is making yet, so that it ends whether or not another worker ever comes.
    """
    flow_runs, deployment = parameters.pop("flow_runs"), parameters.pop("deployment")
    if flow_runs < 1 or parameters["shards"] is not None:
        raise TrilightError(
            f"flow_runs is {flow_runs} and shards {parameters['shards']!r}; expected at least 1 "
            "and no range, since the whole dataset is made."
        )
    prepare_assets(**parameters)
    if flow_runs > 1:
        _start_ranges(parameters, flow_runs, deployment)
    generate_scenes(**parameters)


def _start_ranges(parameters: dict[str, Any], flow_runs: int, deployment: str) -> None:
    count = read_status(parameters["out"]).shards_planned
    bounds = [count * part // flow_runs for part in range(flow_runs + 1)]
    names = [field.name for field in dataclasses.fields(DatasetOrder)]
    given = {name: _json(parameters[name]) for name in names}
    for first, last in itertools.pairwise(bounds):
        if first < last:
            ranged = {**given, "shards": f"{first}:{last}"}
            run_deployment(deployment, parameters=ranged, timeout=0, as_subflow=False)


def _json(value: Any) -> Any:
    return value.model_dump(exclude_unset=True) if hasattr(value, "model_dump") else value
