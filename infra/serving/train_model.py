"""The flow `train-model`: a training run as a process, or as several by torchrun.

It stands in `infra`, where making and learning may both be seen: the form has every setting of
`train.settings`, and what a run refuses is refused before its process exists, without torch.
"""

import contextlib
from collections.abc import Mapping
from typing import Any, Literal

from prefect import flow
from prefect.concurrency.sync import concurrency
from prefect.logging import get_run_logger

from infra.train_order import TrainOrder
from pipeline.flows.forms import PublicUrl, changed_values, changes_form, parameters_of
from pipeline.flows.limits import GPU_LIMIT
from pipeline.flows.process import run_to_end
from pipeline.making.machine import visible_gpus
from storage.errors import TrilightError
from train.runs import RUNS, smoke
from train.settings import TrainSettings

RunName = Literal[tuple(RUNS)]  # type: ignore[valid-type]
"""A list to choose from."""
RunChanges = changes_form(TrainSettings, smoke())
"""Every setting of a run; what stays empty is as the run has it."""


TRAIN_FORMS: Mapping[str, Any] = {
    "run": RunName,
    "data": list[PublicUrl],
    "begin_with": PublicUrl | None,
    "branch": PublicUrl | None,
    "lpips": PublicUrl | None,
    "changes": RunChanges | None,
}
"""Types of parameters that are narrower in a form than in an order."""


def train_order(parameters: Mapping[str, Any]) -> TrainOrder:
    """Return the order that the flow's parameters state.

    Raises:
        TrilightError: a value that no schema can refuse, such as one that does not fit another
            setting of the run; the message names it.
    """
    converted = {
        "data": tuple(parameters["data"]),
        "changes": changed_values(parameters["changes"]),
    }
    order = TrainOrder(**{**parameters, **converted})
    order.settings()
    return order


def _run_name() -> str:
    """Return what the flow run that begins is called: what is trained, and where."""
    from prefect.runtime import flow_run

    parameters = {"run": TrainOrder.run, **flow_run.parameters}
    return "-".join(filter(None, [parameters["run"], parameters.get("out")]))


@flow(name="train-model", flow_run_name=_run_name, persist_result=False)
@parameters_of(TrainOrder, **TRAIN_FORMS)
def train_model(**parameters: Any) -> None:
    """Train a model on a dataset, in processes of its own; a run that is cancelled is saved.

    Prefect waits for half a minute then; `resume` goes on from there.
    """
    order = train_order(parameters)
    log = get_run_logger()
    cards = len(visible_gpus())
    limit = (
        concurrency(GPU_LIMIT, occupy=min(order.processes, cards), strict=False)
        if cards
        else contextlib.nullcontext()
    )
    with limit:
        status, last = run_to_end(order.command(), lambda line: log.info("%s", line))
    if status:
        raise TrilightError(f"train {order.run} ended with status {status}: {last}")
