"""Names that a shell completes; each press of the tab key imports this module."""

from collections.abc import Callable


def _builds() -> list[str]:
    from pipeline.builds.named import BUILDS

    return list(BUILDS)


def _runs() -> list[str]:
    from train.runs import RUNS

    return list(RUNS)


def _sizes() -> list[str]:
    from model.config import SIZES

    return list(SIZES)


def _runners() -> list[str]:
    from pipeline.executors.registry import EXECUTORS

    return list(EXECUTORS)


NAMES: dict[str, Callable[[], list[str]]] = {
    "build": _builds,
    "run": _runs,
    "network": _sizes,
    "runner": _runners,
}
"""Known names by the field that takes one; a field may also take a name that is not listed."""
