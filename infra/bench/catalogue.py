"""Catalogue of experiments: each file of the folder `experiments` holds one."""

import importlib
import pkgutil

from infra.bench import experiments
from infra.bench.experiment import Experiment
from storage.errors import TrilightError


def every_experiment() -> dict[str, Experiment]:
    """Return all experiments by name, in the order of the alphabet."""
    modules = sorted(module.name for module in pkgutil.iter_modules(experiments.__path__))
    experiments_found = [
        importlib.import_module(f"{experiments.__name__}.{name}").EXPERIMENT for name in modules
    ]
    return {one.name: one for one in experiments_found}


def experiment_of(name: str) -> Experiment:
    """Return the experiment of a name.

    Raises:
        TrilightError: the name is unknown; the message has all that exist.
    """
    known = every_experiment()
    if name not in known:
        raise TrilightError(f"experiment {name!r} is unknown; expected one of {', '.join(known)}.")
    return known[name]
