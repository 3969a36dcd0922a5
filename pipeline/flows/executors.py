"""Who runs the tasks of a dataset, by the name that `--runner` takes."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.flows.prefect_server import prefect_server, quiet_prefect
from pipeline.making.order import DatasetOrder
from storage.errors import TrilightError, expected_one_of
from storage.registry import Registry

if TYPE_CHECKING:
    from pipeline.making.dataset_run import Outcome


@dataclass(frozen=True, kw_only=True)
class Executor:
    """A way to make a dataset; the same order gives the same bytes in each."""

    make: "Callable[[DatasetOrder, str | None], Outcome]"
    """Makes an order, or what is missing of it; the second argument is `--address`."""
    needs_address: bool = False
    """Whether `--address` says where; without, it is refused."""
    takes_workers: bool = True
    """Whether `--workers` says how many tasks run at a time."""


def _on_threads(order: DatasetOrder, address: str | None) -> "Outcome":
    from pipeline.making.dataset_run import make_dataset  # slow, since it brings every stage
    from pipeline.making.runners import ThreadRunner

    return make_dataset(order, ThreadRunner())


def _on_dask(order: DatasetOrder, address: str | None) -> "Outcome":
    assert address is not None
    quiet_prefect()
    with prefect_server():
        from pipeline.flows.on_dask import make_on_dask

        return make_on_dask(order, address)


EXECUTORS: Registry[Executor] = Registry(
    "runner",
    Executor,
    {
        "threads": Executor(make=_on_threads),
        "dask": Executor(make=_on_dask, needs_address=True, takes_workers=False),
    },
)
"""By name. How a dataset is made does not stand in it."""


def find_executor(name: str, address: str | None, workers: int | None) -> Executor:
    """Return an executor.

    Args:
        name: as `--runner` gives it.
        address, workers: what `--address` and `--workers` say.

    Raises:
        TrilightError: an unknown name, or an option that the executor has no use for, or lacks.
    """
    if name not in EXECUTORS:
        raise TrilightError(f"--runner is {name!r}; {expected_one_of(name, EXECUTORS)}.")
    executor = EXECUTORS[name]
    if executor.needs_address != (address is not None):
        with_address = " or ".join(each for each, one in EXECUTORS.items() if one.needs_address)
        raise TrilightError(
            f"--runner is {name} and --address is {address}; expected an address with --runner "
            f"{with_address}, and only then."
        )
    if workers is not None and not executor.takes_workers:
        raise TrilightError(
            f"--workers is {workers}; expected it without --runner {name}: how many tasks run at a "
            "time is how many threads the cluster's workers have. Leave it away."
        )
    return executor
