"""`python -m trilight`, also under torchrun: the command line."""

import sys

from storage.installation import order_installed_first

sys.path[:] = order_installed_first(sys.path)  # `python -m` puts the working folder first

from infra.cli.app import main  # noqa: E402

if __name__ == "__main__":
    main()
