"""The flow `build-dataset`: objects, then scenes, then the documents, by one worker or by many."""

import dataclasses
from typing import Any

from prefect import flow
from prefect.deployments import run_deployment

from pipeline.flows.forms import parameters_of
from pipeline.flows.generate_scenes import generate_scenes
from pipeline.flows.orders import DATASET_FORMS, DatasetInRuns, dataset_in_runs, run_name
from pipeline.flows.prepare_assets import prepare_assets
from pipeline.making.order import DatasetOrder
from pipeline.making.tasks import shard_ranges
from storage.dataset.status import read_status


@flow(name="build-dataset", flow_run_name=run_name, persist_result=False)
@parameters_of(DatasetInRuns, **DATASET_FORMS)
def build_dataset(**parameters: Any) -> None:
    """Make a dataset: its objects, its scenes, its documents; on several workers if asked for.

    With N flow runs there are N ranges of shards: N - 1 are runs of their own, and this run makes
    the first. Then it makes what is left and nobody is at, so that it ends whether or not another
    worker ever comes.
    """
    order = dataset_in_runs(parameters)
    given = {field.name: parameters[field.name] for field in dataclasses.fields(DatasetOrder)}
    prepare_assets(**given)
    if order.flow_runs > 1:
        own, *others = shard_ranges(read_status(order.place).shards_planned, order.flow_runs)
        for shards in others:
            ranged = {name: _json(value) for name, value in given.items()} | {"shards": shards}
            run_deployment(order.deployment, parameters=ranged, timeout=0, as_subflow=False)
        generate_scenes(**{**given, "shards": own})
    generate_scenes(**given)


def _json(value: Any) -> Any:
    return value.model_dump(exclude_unset=True) if hasattr(value, "model_dump") else value
