"""Prefect flows `prepare-assets`, `generate-scenes` and `build-dataset`, which combines both."""

import dataclasses
from typing import Any

from prefect import flow
from prefect.deployments import run_deployment
from prefect.logging import get_run_logger

from pipeline.flows.forms import (
    DATASET_FORMS,
    DatasetInRuns,
    options_of_form,
    parameters_of,
    run_name,
)
from pipeline.flows.prefect_runner import PrefectRunner
from pipeline.flows.run_artifacts import make_with_artifacts
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.generation_run import Outcome
from pipeline.generation.pipeline import prepare_dataset
from pipeline.generation.tasks import shard_ranges
from storage.dataset.progress import read_status


@flow(name="prepare-assets", flow_run_name=run_name, persist_result=False)
@parameters_of(GenerateOptions, **DATASET_FORMS)
def prepare_assets(**parameters: Any) -> None:
    """Begin a dataset: list, clean, decimate and freeze its objects, without a picture."""
    run = prepare_dataset(options_of_form(parameters, GenerateOptions))
    get_run_logger().info(
        "%d of %d objects accepted", run.accepted.num_objects, run.accepted.num_found
    )


@flow(name="generate-scenes", flow_run_name=run_name, persist_result=False)
@parameters_of(GenerateOptions, **DATASET_FORMS)
def generate_scenes(**parameters: Any) -> Outcome:
    """Make a dataset: all its missing shards, or those of a range."""
    return make_with_artifacts(options_of_form(parameters, GenerateOptions), PrefectRunner())


@flow(name="build-dataset", flow_run_name=run_name, persist_result=False)
@parameters_of(DatasetInRuns, **DATASET_FORMS)
def build_dataset(**parameters: Any) -> None:
    """Make a dataset: its objects, its scenes, its documents; on several workers if requested.

    With N flow runs there are N ranges of shards: N - 1 are runs of their own, and this run makes
    the first. Then it makes all remaining shards that no worker has claimed, so that it ends even
    if no other worker ever starts.
    """
    options = options_of_form(parameters, DatasetInRuns)
    values = {field.name: parameters[field.name] for field in dataclasses.fields(GenerateOptions)}
    prepare_assets(**values)
    if options.flow_runs > 1:
        first, *rest = shard_ranges(read_status(options.place).shards_planned, options.flow_runs)
        for shards in rest:
            ranged = {name: _json(value) for name, value in values.items()} | {"shards": shards}
            run_deployment(options.deployment, parameters=ranged, timeout=0, as_subflow=False)
        generate_scenes(**{**values, "shards": first})
    generate_scenes(**values)


def _json(value: Any) -> Any:
    return value.model_dump(exclude_unset=True) if hasattr(value, "model_dump") else value
