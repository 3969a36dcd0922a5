"""The flow `generate-scenes`: objects, or scenes in files, to shards."""

from typing import Any

from prefect import flow

from pipeline.flows.forms import parameters_of
from pipeline.flows.orders import DATASET_FORMS, dataset_order, run_name
from pipeline.flows.runner import PrefectRunner
from pipeline.flows.watching import make_watched
from pipeline.making.order import DatasetOrder
from pipeline.making.run import Outcome


@flow(name="generate-scenes", flow_run_name=run_name, persist_result=False)
@parameters_of(DatasetOrder, **DATASET_FORMS)
def generate_scenes(**parameters: Any) -> Outcome:
    """Make a dataset, or what is missing of it, or of a range of its shards."""
    return make_watched(dataset_order(parameters), PrefectRunner())
