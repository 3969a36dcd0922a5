"""`python -m trilight`, also under torchrun: the command line."""

import os
import signal
import sys

# Ctrl-C during imports ends at once without a traceback; `main` installs its own handler
signal.signal(signal.SIGINT, lambda *_: os._exit(130))

from storage.installation import order_installed_first  # noqa: E402

sys.path[:] = order_installed_first(sys.path)  # `python -m` puts the working folder first

from infra.cli.app import main  # noqa: E402

if __name__ == "__main__":
    main()
