"""Location of our packages and files: in a checkout, or below `trilight` as a wheel installs them.

A wheel moves the packages into `trilight`, so that a user's own `model` or `train` stays the user's
(infra/setup/build_backend.py). Commands that name one of our modules take its name from here.
"""

import os
import site
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

_PREFIX = __name__.removesuffix("storage.installation")

FILES_ROOT = Path(__file__).parents[1]
"""The folder that holds our packages and prefect.yaml: the checkout, or the package `trilight`."""

IMPORT_ROOT = Path(__file__).parents[__name__.count(".")]
"""The folder from which `python -m` finds our modules: the checkout, or site-packages."""


def module_name(name: str) -> str:
    """Return the name under which a module such as `pipeline.assets.prepare` is imported here."""
    return f"{_PREFIX}{name}"


def installed_version(library: str, otherwise: str = "") -> str:
    """Return the version of an installed library, or `otherwise`."""
    try:
        return metadata.version(library)
    except metadata.PackageNotFoundError:
        return otherwise


def child_environment() -> dict[str, str]:
    """Return this process's environment for a Python child, which finds our modules.

    The child imports nothing from the working folder, for which an empty entry of PYTHONPATH
    stands too.
    """
    paths = _named_paths()
    if str(IMPORT_ROOT) not in [*paths, *site.getsitepackages(), site.getusersitepackages()]:
        paths.append(str(IMPORT_ROOT))
    return {**os.environ, "PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(paths)}


def order_installed_first(paths: Sequence[str]) -> list[str]:
    """Return import paths with the working folder last, where it hides nothing that is installed.

    It keeps its place where it is named by PYTHONPATH, or holds our modules.
    """
    try:
        folder = os.getcwd()
    except FileNotFoundError:  # it was deleted
        return list(paths)
    if folder in [*_named_paths(), str(IMPORT_ROOT)]:
        return list(paths)
    other_paths = [path for path in paths if path not in ("", folder)]
    # a hook of pip's finds us later
    ours = [] if str(IMPORT_ROOT) in other_paths else [str(IMPORT_ROOT)]
    return [*other_paths, *ours, *(path for path in paths if path in ("", folder))]


def _named_paths() -> list[str]:
    named = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    return [os.path.abspath(path) for path in named if path]
