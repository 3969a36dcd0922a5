"""`python -m trilight`, also under torchrun: the command line."""

import os
import signal
import sys
from typing import NoReturn


def _interrupted(*_: object) -> NoReturn:
    """Leave on Ctrl-C while libraries are loaded; `main` has words of its own."""
    os.write(2, b"trilight: interrupted; nothing was begun.\n")
    os._exit(130)


signal.signal(signal.SIGINT, _interrupted)

from storage.installation import order_installed_first  # noqa: E402

sys.path[:] = order_installed_first(sys.path)  # `python -m` puts the working folder first

from infra.cli.app import main  # noqa: E402

if __name__ == "__main__":
    main()
