"""`trilight generate`: objects, or scenes in files, to shards."""

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

from infra.cli.changes import Shared
from infra.cli.console import first_words, note
from infra.cli.dataset_changes import with_shared
from infra.cli.generate_progress import watched
from infra.cli.generate_report import report
from infra.cli.options import Shown, command
from pipeline.flows.order import DatasetOrder
from pipeline.flows.prefect_server import prefect_server, quiet_prefect
from pipeline.renders.variant import choose_variant
from storage.errors import TrilightError
from storage.output import dataset_folder
from storage.settings import checked

if TYPE_CHECKING:
    from pipeline.flows.dataset_run import Outcome


@checked()
class Runner:
    """Who does the work."""

    runner: Literal["threads", "dask"] = "threads"
    """Threads of this process, or the workers of a Dask cluster."""
    address: str | None = None
    """With --runner dask: the scheduler, such as tcp://host:8786; by default there is none."""

    def __post_init__(self) -> None:
        if (self.runner == "dask") != (self.address is not None):
            raise TrilightError(
                f"--runner is {self.runner} and --address is {self.address}; expected an address "
                "with --runner dask, and only then."
            )


@command("build")
def generate(order: DatasetOrder, shared: Shared, runner: Runner, shown: Shown) -> None:
    order = with_shared(order, shared)
    folder, started = dataset_folder(order.place), time.monotonic()
    first_words(f"Making {folder.shown} with the build {order.build}", silent=shown.json)
    make = _maker(runner, order.workers)
    if (text := choose_variant().note) and not shown.json:
        note(f"{text}; see trilight doctor")
    with watched(folder, silent=shown.json):
        outcome = make(order)
    report(folder, outcome, time.monotonic() - started, as_json=shown.json)


def _maker(runner: Runner, workers: int | None) -> "Callable[[DatasetOrder], Outcome]":
    """Return what makes an order; imports are slow, since they bring every stage."""
    address = runner.address
    if address is not None and workers is not None:
        raise TrilightError(
            f"--workers is {workers}; expected it without --runner dask, where the threads of the "
            "cluster's workers say how many tasks run at a time: omit --workers."
        )
    if address is None:
        from pipeline.flows.dataset_run import make_dataset
        from pipeline.flows.runners import ThreadRunner

        return lambda order: make_dataset(order, ThreadRunner())
    quiet_prefect()

    def on_cluster(order: DatasetOrder) -> "Outcome":
        with prefect_server():
            from pipeline.flows.served.on_dask import make_on_dask

            return make_on_dask(order, address)

    return on_cluster
