"""The flow `improve`: rounds of generate, train and judge, watched on Prefect's page.

It stands in `infra`, where making and learning may both be seen. Making a round is what the flow
`generate-scenes` does, training it what `train-model` does, with their artifacts; each round that
is done adds a table of weights and losses, and a picture of all rounds so far.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

from prefect import flow
from prefect.artifacts import create_image_artifact, create_table_artifact
from prefect.logging import get_run_logger

from infra.improve.local import core_s_of
from infra.improve.order import ImproveOrder
from infra.improve.report import picture_of, rows_of
from infra.improve.rounds import LoopWorkers, improve
from infra.improve.state import Drawn, Lessons, Rounds
from infra.serving.train_model import RunChanges, RunName, train_in_process
from infra.train_order import TrainOrder
from pipeline.flows.forms import (
    BuildChanges,
    BuildName,
    PublicUrl,
    changed_values,
    parameters_of,
)
from pipeline.flows.prefect_runner import PrefectRunner
from pipeline.flows.watching import make_watched, small_picture
from storage.remote.safe_url import safe_text

IMPROVE_FORMS: Mapping[str, Any] = {
    "build": BuildName,
    "objects": PublicUrl | None,
    "run": RunName,
    "changes": BuildChanges | None,
    "run_changes": RunChanges | None,
}
"""Types of parameters that are narrower in a form than in an order."""


def improve_order(parameters: Mapping[str, Any]) -> ImproveOrder:
    """Return the order that the flow's parameters state.

    Raises:
        TrilightError: a value that no schema can refuse; the message names it.
    """
    changes = {name: changed_values(parameters[name]) for name in ("changes", "run_changes")}
    return ImproveOrder(**{**parameters, "axes": tuple(parameters["axes"]), **changes})


def _run_name() -> str:
    """Return what the flow run that begins is called: what is drawn, trained, and where."""
    from prefect.runtime import flow_run

    plain = {name: getattr(ImproveOrder, name) for name in ("build", "run", "out")}
    given = {**plain, **flow_run.parameters}
    return "-".join(str(given[name]) for name in plain)


@flow(name="improve", flow_run_name=_run_name, persist_result=False)
@parameters_of(ImproveOrder, **IMPROVE_FORMS)
def improve_loop(**parameters: Any) -> None:
    """Generate, train and judge in rounds, and generate next where a core-second teaches most.

    A run that was cancelled or killed goes on where it stopped: start it again with the same form.
    """
    order, log = improve_order(parameters), get_run_logger()

    def train(training: TrainOrder) -> float:
        return core_s_of(partial(train_in_process, training))

    def begins(number: int, what: str) -> None:
        log.info("round %d of %d: %s", number, order.rounds, what)

    shown = _Shown(order)
    improve(
        order,
        LoopWorkers(
            make=lambda dataset: make_watched(dataset, PrefectRunner()),
            train=train,
            told=shown.round_done,
            begins=begins,
        ),
    )


class _Shown:
    """Artifacts of the rounds; a run goes on where they cannot be shown."""

    def __init__(self, order: ImproveOrder) -> None:
        self._rounds = Rounds(order)
        self._found: list[Lessons] = []

    def round_done(self, number: int, drawn: Drawn, lessons: Lessons) -> None:
        self._found.append(lessons)
        try:
            rows = [
                row for row in rows_of(self._rounds, self._found) if row["round"] == str(number)
            ]
            what = f"round {number}: what was drawn, and what it taught"
            create_table_artifact(rows, key="strata", description=what)
            picture = small_picture(picture_of(self._rounds))
            create_image_artifact(picture, key="rounds", description=self._rounds.order.out)
        except Exception as error:  # a server away for a moment must not cost hours of work
            why = safe_text(str(error).partition("\n")[0])
            get_run_logger().warning("what this page shows is not complete (%s)", why)
