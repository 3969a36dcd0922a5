"""The limits of flows on what they share, wherever a server runs: of `make serve`, of the images.

A flow takes a slot of a limit where it writes documents, and where it uses a graphics card. A limit
that does not exist limits nothing, so every deployment makes them.
"""

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from pipeline.flows.machine import visible_gpus
from pipeline.flows.served.limits import DISK_LIMIT, GPU_LIMIT
from storage.errors import TrilightError

ROOT = Path(__file__).parents[2]
_DISK_SLOTS = 2
"""Runs that write documents at the same time: each reads its whole dataset."""
_MOST_CARDS = 100_000


def make_limits(environment: Mapping[str, str]) -> None:
    """Make the limits at a server, or set them anew.

    Args:
        environment: says where the server is; TRILIGHT_CARDS says how many graphics cards all its
            workers have, where that is not those of this machine.

    Raises:
        TrilightError: TRILIGHT_CARDS is no number of cards, or the server refuses.
    """
    for name, limit in ((DISK_LIMIT, _DISK_SLOTS), (GPU_LIMIT, _cards(environment))):
        known = call_prefect(["gcl", "inspect", name], environment, check=False)
        action = "update" if known else "create"
        call_prefect(["gcl", action, name, "--limit", str(limit)], environment)


def call_prefect(
    arguments: list[str], environment: Mapping[str, str], *, check: bool = True
) -> bool:
    """Run a command of Prefect's and return whether it succeeded.

    Args:
        arguments: behind `prefect`.
        environment: says where the server is.
        check: whether a failure is an error.

    Raises:
        TrilightError: it failed; the message ends with its last line.
    """
    done = subprocess.run(
        ["prefect", "--no-prompt", *arguments],
        cwd=ROOT,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    if check and done.returncode:
        last = (done.stderr.strip() or done.stdout.strip()).splitlines()[-1:]
        raise TrilightError(f"prefect {' '.join(arguments)} failed: {' '.join(last)}")
    return done.returncode == 0


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


if __name__ == "__main__":
    try:
        make_limits(os.environ)
    except TrilightError as mistake:
        sys.exit(f"trilight: {mistake}")
