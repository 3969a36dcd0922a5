"""The executors that run a dataset's tasks, by the name that `--runner` takes.

The engine (pipeline.generation) imports none of their modules. A `make` narrows the options or
begins a flow, and then calls `make_dataset` with a `Runner` (pipeline.generation.generation_run).
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

from pipeline.generation.generate_options import GenerateOptions
from storage.errors import TrilightError, expected_one_of
from storage.installation import module_name
from storage.registry import Registry

if TYPE_CHECKING:
    from pipeline.generation.generation_run import Outcome

Make = Callable[[GenerateOptions, str | None], "Outcome"]


@dataclass(frozen=True, kw_only=True)
class Executor:
    """Runs the tasks of a dataset; equal options give equal bytes with each executor."""

    make: Make
    """Makes the dataset of some options; the second argument is `--address`."""
    needs_address: bool = False
    """True if `--address` is required; otherwise it is refused."""
    takes_workers: bool = True
    """True if `--workers` sets how many tasks run at the same time."""


def _load_on_use(module: str, name: str = "make") -> Make:
    """Return a function that imports a module when it is called, and calls a function of it.

    The import loads every stage, and for some executors packages that may not be installed.
    """
    return lambda *args: getattr(import_module(module_name(module)), name)(*args)


EXECUTORS: Registry[Executor] = Registry(
    "runner",
    Executor,
    {
        "threads": Executor(make=_load_on_use("pipeline.executors.threads")),
        "slurm": Executor(make=_load_on_use("pipeline.executors.threads", "make_slurm")),
        "kubernetes": Executor(make=_load_on_use("pipeline.executors.threads", "make_kubernetes")),
        "prefect": Executor(make=_load_on_use("pipeline.flows.flow_executors")),
        "dask": Executor(
            make=_load_on_use("pipeline.flows.flow_executors"),
            needs_address=True,
            takes_workers=False,
        ),
    },
)
"""Executors by name. No dataset records which one made it."""


def find_executor(name: str, address: str | None, workers: int | None) -> Executor:
    """Return an executor.

    Raises:
        TrilightError: the name is unknown, or an option is missing or not supported.
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
