"""Names that a shell completes; each press of the tab key imports this module."""

from collections.abc import Callable
from importlib import import_module
from typing import Any

_TABLES = {
    "build": ("pipeline.builds.named", "BUILDS"),
    "run": ("train.runs", "RUNS"),
    "network": ("model.config", "SIZES"),
    "runner": ("pipeline.executors.registry", "EXECUTORS"),
}
"""Table of known names by the field that takes one; a field may also take another name."""


def completer(field: str) -> Callable[[Any], list[str]] | None:
    """Return the function that lists the names which a field takes; None where any text goes."""
    if field not in _TABLES:
        return None
    module, table = _TABLES[field]
    return lambda _: list(getattr(import_module(module), table))
