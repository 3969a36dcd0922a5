"""The flow `improve`: rounds of generate, train and judge, watched on Prefect's page.

It stands in `infra`, where making and learning may both be seen. Making a round is what the flow
`generate-scenes` does, training it what `train-model` does, with their artifacts; each round that
is done adds a table of weights and losses, and a picture of all rounds so far.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any, cast
from uuid import UUID

from prefect import flow
from prefect.artifacts import (
    create_image_artifact,
    create_progress_artifact,
    create_table_artifact,
    update_progress_artifact,
)
from prefect.logging import get_run_logger

from infra.improve.local import core_s_of
from infra.improve.order import ImproveOrder
from infra.improve.report import picture_of, rows_of, summary_of
from infra.improve.rounds import STEPS, LoopWorkers, improve
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
from pipeline.flows.submission import WHOLE
from pipeline.flows.watching import Forgiving, make_watched, small_picture

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
    order = improve_order(parameters)

    def train(training: TrainOrder) -> float:
        return core_s_of(partial(train_in_process, training))

    shown = _Shown(order)
    improve(
        order,
        LoopWorkers(
            make=lambda dataset: make_watched(dataset, PrefectRunner()),
            train=train,
            told=shown.round_done,
            begins=shown.begins,
        ),
    )
    shown.finished()


class _Shown:
    """Artifacts of the rounds; a run goes on where they cannot be shown."""

    def __init__(self, order: ImproveOrder) -> None:
        self._rounds = Rounds(order)
        self._found: list[Lessons] = []
        self._log = get_run_logger()
        self._shown = Forgiving(self._log)
        self._progress: UUID | None = None

    def begins(self, number: int, what: str) -> None:
        """Tell what is done from now on: a third of a round."""
        doing = f"round {number} of {self._rounds.order.rounds}: {what}"
        self._log.info("%s", doing)
        self._shown(partial(self._tell, number - 1 + STEPS.index(what) / len(STEPS), doing))

    def round_done(self, number: int, drawn: Drawn, lessons: Lessons) -> None:
        """Show a round that is done, also one that was before."""
        self._found.append(lessons)
        self._shown(partial(self._show_round, number))

    def finished(self) -> None:
        """Sum the loop up; a dataset's summary, which each round has, is older."""
        rows = [{"what": what, "value": value} for what, value in summary_of(self._found)]
        self._shown(partial(self._tell, len(self._found), "all rounds are done"))
        where = self._rounds.order.out
        self._shown(partial(create_table_artifact, rows, key="summary", description=where))

    def _tell(self, rounds: float, doing: str) -> None:
        percent = 100.0 * rounds / self._rounds.order.rounds
        if self._progress is None:
            # Prefect's functions return coroutines only where an event loop runs
            self._progress = cast(
                UUID, create_progress_artifact(percent, key=WHOLE, description=doing)
            )
        else:
            update_progress_artifact(self._progress, percent, description=doing)

    def _show_round(self, number: int) -> None:
        rows = [row for row in rows_of(self._rounds, self._found) if row["round"] == str(number)]
        what = f"round {number}: what was drawn, and what it taught"
        create_table_artifact(rows, key="strata", description=what)
        picture = small_picture(picture_of(self._rounds))
        create_image_artifact(picture, key="rounds", description=self._rounds.order.out)
