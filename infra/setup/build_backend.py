"""Build backend of Trilight: setuptools, with wheels built from the tree of wheel_tree.

Editable installs use the checkout's path: next to a clone, whose folder has the name of the
package, Python would not call an import hook. A wheel is an ordinary setuptools build of another
folder, so that neither metadata nor file list depend on the move.
"""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from setuptools import build_meta
from setuptools.build_meta import (
    build_sdist,
    get_requires_for_build_editable,
    get_requires_for_build_sdist,
    get_requires_for_build_wheel,
    prepare_metadata_for_build_editable,
)

from infra.setup.wheel_tree import write_wheel_tree

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
    "prepare_metadata_for_build_editable",
    "prepare_metadata_for_build_wheel",
]


def build_editable(
    wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None
) -> str:
    """Build an editable wheel into a folder and return its name (PEP 660)."""
    settings = {"editable_mode": "compat", **(config_settings or {})}
    return str(build_meta.build_editable(wheel_directory, settings, metadata_directory))


def build_wheel(
    wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None
) -> str:
    """Build a wheel into a folder and return its name (PEP 517)."""
    folder = os.path.abspath(wheel_directory)
    with _in_wheel_tree():
        return str(build_meta.build_wheel(folder, config_settings, metadata_directory))


def prepare_metadata_for_build_wheel(metadata_directory: str, config_settings: Any = None) -> str:
    """Write the wheel's .dist-info into a folder and return its name (PEP 517)."""
    folder = os.path.abspath(metadata_directory)
    with _in_wheel_tree():
        return str(build_meta.prepare_metadata_for_build_wheel(folder, config_settings))


@contextlib.contextmanager
def _in_wheel_tree() -> Iterator[None]:
    checkout = Path.cwd()  # a front end calls from the checkout, by PEP 517
    with tempfile.TemporaryDirectory() as tree:
        write_wheel_tree(checkout, Path(tree))
        with contextlib.chdir(tree):
            yield
