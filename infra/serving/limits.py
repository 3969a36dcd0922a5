"""The limits of flows on what they share, wherever a server runs: of `make serve`, of the images.

A flow takes a slot of a limit where it writes documents, and where it uses a graphics card. A limit
that does not exist limits nothing, so infra.serving.deployments makes them first.
"""

from collections.abc import Mapping

from pipeline.flows.limits import DISK_LIMIT, GPU_LIMIT
from pipeline.making.machine import visible_gpus
from storage.errors import TrilightError

_DISK_SLOTS = 2
"""Runs that write documents at the same time: each reads its whole dataset."""
_MOST_CARDS = 100_000


def limits(environment: Mapping[str, str]) -> dict[str, int]:
    """Return the slots of each limit.

    Args:
        environment: TRILIGHT_CARDS says how many graphics cards all workers have, where that is
            not those of this machine.

    Raises:
        TrilightError: TRILIGHT_CARDS is no number of cards.
    """
    return {DISK_LIMIT: _DISK_SLOTS, GPU_LIMIT: _cards(environment)}


def _cards(environment: Mapping[str, str]) -> int:
    """Return the cards, or 1 where there is none: a limit of 0 would let nothing begin."""
    text = environment.get("TRILIGHT_CARDS")
    if text is None:
        return len(visible_gpus()) or 1
    if not (text.isascii() and text.isdecimal()) or not 1 <= int(text) <= _MOST_CARDS:
        raise TrilightError(
            f"TRILIGHT_CARDS is {text!r}; expected a whole number from 1 to {_MOST_CARDS}."
        )
    return int(text)
