"""Who runs the tasks of a dataset, by the name that `--runner` takes.

Executors are peers: each is a module with a function `make`, and none is known to the engine
(pipeline.making). `make` narrows an order or begins a flow, and then calls `make_dataset` with a
`Runner` (pipeline.making.runner).
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

from pipeline.making.dataset_order import DatasetOrder
from storage.errors import TrilightError, expected_one_of
from storage.installation import module_name
from storage.registry import Registry

if TYPE_CHECKING:
    from pipeline.making.run import Outcome

Make = Callable[[DatasetOrder, str | None], "Outcome"]


@dataclass(frozen=True, kw_only=True)
class Executor:
    """A way to make a dataset; the same order gives the same bytes in each."""

    make: Make
    """Makes an order, or what is missing of it; the second argument is `--address`."""
    needs_address: bool = False
    """Whether `--address` says where; without, it is refused."""
    takes_workers: bool = True
    """Whether `--workers` says how many tasks run at a time."""


def _made_by(module: str) -> Make:
    """Return the function `make` of a module, which is loaded when a dataset is made.

    Loading brings every stage, and for some executors packages that may not be installed.
    """

    def make(order: DatasetOrder, address: str | None) -> "Outcome":
        outcome: Outcome = import_module(module_name(module)).make(order, address)
        return outcome

    return make


EXECUTORS: Registry[Executor] = Registry(
    "runner",
    Executor,
    {
        "threads": Executor(make=_made_by("pipeline.executors.threads")),
        "slurm": Executor(make=_made_by("pipeline.executors.slurm")),
        "kubernetes": Executor(make=_made_by("pipeline.executors.kubernetes")),
        "prefect": Executor(make=_made_by("pipeline.flows.on_prefect")),
        "dask": Executor(
            make=_made_by("pipeline.flows.on_dask"), needs_address=True, takes_workers=False
        ),
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
            f"--workers is {workers}; expected none with --runner {name}: the threads of the "
            "cluster's workers set how many tasks run at once. Omit --workers."
        )
    return executor
