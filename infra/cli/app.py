"""The command `trilight`: what it does with a mistake, and with Ctrl-C."""

import os
import shlex
import signal
import sys
from types import FrameType

from cyclopts import CycloptsError

from infra.cli.commands import app, complaint
from infra.cli.extending import extended
from infra.cli.leaving import leave
from storage.errors import TrilightError


def main() -> None:
    """Run the command line; a mistake of the user is one line on stderr and exit status 1."""
    # torch's threads would wait for each other in busy loops, which beside other work made training
    # twelve times slower; read when torch is imported, and a setting of the user's own wins
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    signal.signal(signal.SIGINT, _interrupted)
    try:
        app(extended(sys.argv[1:]))
    except CycloptsError as mistake:
        leave(f"trilight: {complaint(mistake)}", 2)
    except TrilightError as mistake:
        leave(f"trilight: {mistake}", mistake.exit_status)


def _interrupted(signal_number: int, frame: FrameType | None) -> None:
    again = shlex.join(["trilight", *sys.argv[1:]])
    leave(f"trilight: interrupted. What was finished is safe; to go on, run: {again}", 130)


if __name__ == "__main__":
    main()
