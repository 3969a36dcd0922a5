"""All experiments, found by listing the folder `experiments`; a file is a family of them."""

import importlib
import pkgutil
from collections.abc import Mapping, Sequence

from infra.bench import experiments
from infra.bench.experiment import Experiment
from storage.errors import TrilightError, expected_one_of


def families() -> Mapping[str, tuple[Experiment, ...]]:
    """Return the experiments by the name of their file, in the order of the alphabet."""
    names = sorted(module.name for module in pkgutil.iter_modules(experiments.__path__))
    return {
        name: importlib.import_module(f"{experiments.__name__}.{name}").EXPERIMENTS
        for name in names
    }


def every_experiment() -> tuple[Experiment, ...]:
    """Return all experiments."""
    return tuple(one for family in families().values() for one in family)


def chosen(names: Sequence[str]) -> list[Experiment]:
    """Return the experiments that are named, alone or by their family; each once.

    Raises:
        TrilightError: a name is unknown.
    """
    by_family = families()
    by_name = {one.name: (one,) for family in by_family.values() for one in family}
    found: dict[str, Experiment] = {}
    for name in names:
        if name not in by_name and name not in by_family:
            expected = expected_one_of(name, (*by_name, *by_family))
            raise TrilightError(f"experiment {name!r} is unknown; {expected}.")
        found |= {one.name: one for one in by_name.get(name) or by_family[name]}
    return list(found.values())
