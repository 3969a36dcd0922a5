"""Prefect flows `prepare-assets`, `generate-scenes`, `build-dataset` (both), and `make-by-array`.

The last one submits a dataset to a scheduler's array, Slurm's or Kubernetes', and shows its
progress. Its worker runs on a machine where `trilight submit slurm` works; it renders nothing,
reads the same files as `trilight status`, and may be killed: another run shows the same. Image,
machines and accounts are set on the worker (TRILIGHT_MACHINES, TRILIGHT_IMAGE), since a person who
may start a run must not choose what runs there.
"""

import contextlib
import dataclasses
import time
from typing import Any

from prefect import flow
from prefect.deployments import run_deployment
from prefect.logging import get_run_logger

from pipeline.executors.slurm_and_kubernetes import (
    DatasetByArray,
    array_job,
    options_from_environment,
    submit_job,
    submit_slurm_array,
)
from pipeline.flows.forms import (
    DATASET_FORMS,
    DatasetInRuns,
    options_of_form,
    parameters_of,
    run_name,
)
from pipeline.flows.prefect_runner import PrefectRunner, RunPage, make_with_page
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.generation_run import Outcome, shard_ranges
from pipeline.generation.pipeline import prepare_dataset
from storage.dataset.progress import missing_shards, read_status
from storage.errors import TrilightError
from storage.number_ranges import number_ranges


@flow(name="prepare-assets", flow_run_name=run_name, persist_result=False)
@parameters_of(GenerateOptions, **DATASET_FORMS)
def prepare_assets(**parameters: Any) -> None:
    """Begin a dataset: list, clean, decimate and freeze its objects, without a picture."""
    accepted = prepare_dataset(options_of_form(parameters, GenerateOptions)).job.accepted
    get_run_logger().info("%d of %d objects accepted", accepted.num_objects, accepted.num_found)


@flow(name="generate-scenes", flow_run_name=run_name, persist_result=False)
@parameters_of(GenerateOptions, **DATASET_FORMS)
def generate_scenes(**parameters: Any) -> Outcome:
    """Make a dataset: all its missing shards, or those of a range."""
    return make_with_page(options_of_form(parameters, GenerateOptions), PrefectRunner())


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


LOOK_S = 20.0
"""Seconds between two looks at the dataset; in a bucket each lists some files."""


@flow(name="make-by-array", flow_run_name=run_name, persist_result=False)
@parameters_of(DatasetByArray, **DATASET_FORMS)
def make_by_array(**parameters: Any) -> None:
    """Submit the missing shards of a dataset to a scheduler, and show the progress until the end.

    Start it again when no task is left in the queue: it submits what is still missing.
    """
    options = options_of_form(parameters, DatasetByArray)
    page = RunPage(options.place)
    if (on := options.scheduler) != "none":
        job = array_job(options, per_task=options.shards_per_task, at_once=options.at_once, on=on)
        if job.tasks:
            name = (
                submit_slurm_array(job)[0]
                if on == "slurm"
                else submit_job(job, options_from_environment())[0].parent.name
            )
            get_run_logger().info(
                "%s has %s: tasks %s of %d shards", on, name, number_ranges(job.tasks), job.per_task
            )
    _watch_until_finished(options, page)
    page.show_result()


def _watch_until_finished(options: DatasetByArray, page: RunPage) -> None:
    """Show a dataset until it is finished; raises TrilightError after too long without scenes."""
    before = None
    changed_s = time.monotonic()
    while True:
        status = None
        with contextlib.suppress(TrilightError):  # no task has begun it
            status = read_status(options.place)
        if status and status.finished and not missing_shards(options.place, options.scenes or 0):
            return  # a lost shard of a finished dataset is made again
        progress = (status.shards_done, status.scenes_done) if status else None
        if progress != before:
            before = progress
            changed_s = time.monotonic()
        if status is not None:
            page.show_status(status)
        if time.monotonic() - changed_s > 3600 * options.quiet_hours:
            done = f"{status.scenes_done} of {status.scenes_planned}" if status else "none"
            raise TrilightError(
                f"{options.place}: no new scene for {options.quiet_hours:g} hours ({done} made); "
                "expected tasks at work. Look at the queue, and run the flow again: it submits "
                "what is missing."
            )
        time.sleep(LOOK_S)
