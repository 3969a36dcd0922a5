"""The flow `prepare-assets`: begins a dataset and freezes its objects, without a picture."""

from typing import Any

from prefect import flow
from prefect.logging import get_run_logger

from pipeline.flows.forms import parameters_of
from pipeline.flows.orders import DATASET_FORMS, dataset_order, run_name
from pipeline.making.order import DatasetOrder
from pipeline.making.pipeline import prepare_dataset


@flow(name="prepare-assets", flow_run_name=run_name, persist_result=False)
@parameters_of(DatasetOrder, **DATASET_FORMS)
def prepare_assets(**parameters: Any) -> None:
    """Begin a dataset: list, clean, decimate and freeze its objects, without a picture."""
    run = prepare_dataset(dataset_order(parameters))
    get_run_logger().info(
        "%d of %d objects accepted", len(run.accepted.objects), run.accepted.num_found
    )
