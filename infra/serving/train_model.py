"""The flow `train-model`: a training run as a process, or as several by torchrun.

It stands in `infra`, where making and learning may both be seen: the form has every setting of
`train.settings`, and what a run refuses is refused before its process exists, without torch.
"""

import contextlib
import json
import sys
from collections.abc import Mapping
from dataclasses import field
from typing import Annotated, Any, Literal

from prefect import flow
from prefect.concurrency.sync import concurrency
from prefect.logging import get_run_logger

from pipeline.flows.machine import visible_gpus
from pipeline.flows.served.limits import GPU_LIMIT
from pipeline.flows.served.process import run_to_end
from pipeline.flows.served.schema import PublicUrl, changed_values, changes_form, parameters_of
from storage.errors import TrilightError
from storage.ranges import Within
from storage.settings import checked
from train.runs import RUNS, changed_run, smoke
from train.settings import TrainSettings
from train.start import Start

RunName = Literal[tuple(RUNS)]  # type: ignore[valid-type]
"""A list to choose from."""
RunChanges = changes_form(TrainSettings, smoke())
"""Every setting of a run; what stays empty is as the run has it."""


@checked()
class TrainOrder:
    """What a person says of a training run."""

    run: str = "smoke"
    """Named run, such as smoke or pretrain."""
    data: tuple[str, ...] = ("data/smoke",)
    """Root of a dataset, or shards by name or pattern; folders or URLs."""
    out: str = "runs/smoke"
    """Folder of the run, as the worker sees it."""
    resume: bool = False
    """Go on from the last checkpoint."""
    begin_with: str | None = None
    """Folder of a run, or checkpoint, whose weights a finetune run begins with."""
    lpips: str | None = None
    """Folder of LPIPS' weights, or hub to download them; otherwise what TRILIGHT_LPIPS says."""
    steps: Annotated[int | None, Within(1, 10**9, unit="steps")] = None
    """Replaces the run's number of steps."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Any other setting of the run, such as perceptual in the group loss."""
    workers: Annotated[int, Within(1, 1024, unit="threads")] = 1
    """Threads that decode samples."""
    processes: Annotated[int, Within(1, 1024, unit="processes")] = 1
    """Processes on this machine, started by torchrun; one for each graphics card."""

    def __post_init__(self) -> None:
        if not self.data:
            raise TrilightError("data is empty; expected at least one dataset.")

    def command(self) -> list[str]:
        """Return the command line that trains."""
        launch = ["-m", "trilight"]
        if self.processes > 1:
            several = f"--nproc-per-node={self.processes}"
            launch = ["-m", "torch.distributed.run", "--standalone", several, *launch]
        options = ["--out", self.out, "--workers", str(self.workers)]
        options += [part for place in self.data for part in ("--data", place)]
        options += ["--resume"] if self.resume else []
        options += [] if self.begin_with is None else ["--from", self.begin_with]
        options += [] if self.lpips is None else ["--lpips", self.lpips]
        options += [] if self.steps is None else ["--steps", str(self.steps)]
        for name, value in sorted(self.changes.items()):
            options += ["--set", f"{name}={json.dumps(value)}"]
        return [sys.executable, *launch, "train", self.run, *options]


TRAIN_FORMS: Mapping[str, Any] = {
    "run": RunName,
    "data": list[PublicUrl],
    "begin_with": PublicUrl | None,
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
    given = {"data": tuple(parameters["data"]), "changes": changed_values(parameters["changes"])}
    order = TrainOrder(**{**parameters, **given})
    settings = changed_run(order.run, order.changes, steps=order.steps)
    Start(resume=order.resume, begin_with=order.begin_with).check(settings, "begin_with")
    return order


@flow(name="train-model", flow_run_name="{run}-{out}", persist_result=False)
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
