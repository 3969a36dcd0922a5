"""Concurrency limits of flows on shared resources, for `make serve` and the container images.

A flow takes a slot of a limit while it writes documents, and while it uses a GPU. A limit that does
not exist limits nothing, so infra.serving.deployments creates them first.
"""

from collections.abc import Mapping

from pipeline.flows.limits import DISK_LIMIT, GPU_LIMIT
from pipeline.renders.visible_gpus import visible_gpus
from storage.errors import TrilightError

_DISK_SLOTS = 2
"""Number of runs that may write documents at the same time: each reads its whole dataset."""
_MOST_CARDS = 100_000


def limits(environment: Mapping[str, str]) -> dict[str, int]:
    """Return the number of slots by limit.

    Args:
        environment: TRILIGHT_CARDS is the number of GPUs of all workers, if these have others than
            this machine.

    Raises:
        TrilightError: TRILIGHT_CARDS is no number of GPUs.
    """
    return {DISK_LIMIT: _DISK_SLOTS, GPU_LIMIT: _cards(environment)}


def _cards(environment: Mapping[str, str]) -> int:
    """Return the number of GPUs, at least 1, because a limit of 0 would block every flow."""
    text = environment.get("TRILIGHT_CARDS")
    if text is None:
        return len(visible_gpus()) or 1
    if not (text.isascii() and text.isdecimal()) or not 1 <= int(text) <= _MOST_CARDS:
        raise TrilightError(
            f"TRILIGHT_CARDS is {text!r}; expected a whole number from 1 to {_MOST_CARDS}."
        )
    return int(text)
