"""The flow `generate-scenes`: objects, or scenes in files, to shards."""

import logging
from typing import Any

from prefect import flow

from pipeline.flows.forms import parameters_of
from pipeline.flows.orders import DATASET_FORMS, dataset_order, run_name
from pipeline.flows.runner import PrefectRunner
from pipeline.flows.watching import Watched
from pipeline.making.dataset_run import Outcome, make_dataset
from pipeline.making.order import DatasetOrder


@flow(name="generate-scenes", flow_run_name=run_name, persist_result=False)
@parameters_of(DatasetOrder, **DATASET_FORMS)
def generate_scenes(**parameters: Any) -> Outcome:
    """Make a dataset, or what is missing of it, or of a range of its shards."""
    return make_watched(dataset_order(parameters), PrefectRunner())


def make_watched(order: DatasetOrder, runner: PrefectRunner) -> Outcome:
    """Make a dataset within a flow run, with its artifacts; the summary also says what failed."""
    # one line per scene; PREFECT_LOGGING_EXTRA_LOGGERS=trilight brings it to the server
    logging.getLogger("trilight").setLevel(logging.INFO)
    watched = Watched(order)
    try:
        outcome = make_dataset(order, runner, watched.task_done)
    except Exception as error:
        watched.failed(error)
        raise
    watched.finished(outcome)
    return outcome
