"""Location of our packages and files: in a checkout, or below `trilight` as a wheel installs them.

A wheel moves the packages into `trilight`, so that a user's own `model` or `train` stays the user's
(infra/setup/wheel_tree.py). Commands that name one of our modules take its name from here.
"""

from pathlib import Path

_PREFIX = __name__.removesuffix("storage.installation")

FILES_ROOT = Path(__file__).parents[1]
"""The folder that holds our packages and prefect.yaml: the checkout, or the package `trilight`."""

IMPORT_ROOT = Path(__file__).parents[__name__.count(".")]
"""The folder from which `python -m` finds our modules: the checkout, or site-packages."""


def module_name(name: str) -> str:
    """Return the name under which a module such as `pipeline.assets.prepare` is imported here."""
    return f"{_PREFIX}{name}"
