"""Build backend of Trilight: setuptools, with wheels built from another source tree.

In a checkout `storage`, `model` and `train` are top-level packages. In a user's environment such
names would collide with other modules, so that a wheel has them as `trilight.storage` and so on, as
pip does with its vendored libraries. A wheel is an ordinary setuptools build of a folder with all
packages below `trilight`, so that neither metadata nor file list depend on the move. Only import
statements change, within their line, so that line numbers stay. Module names in strings are not
rewritten: code that needs one calls storage.installation, or uses `__package__`.

Editable installs use the checkout's path: next to a clone, whose folder has the name of the
package, Python would not call an import hook.

This module imports only setuptools and Python's standard library, since builds run in isolated
environments.
"""

import ast
import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from setuptools import build_meta

build_sdist = build_meta.build_sdist
prepare_metadata_for_build_editable = build_meta.prepare_metadata_for_build_editable
"""Hooks of setuptools that a build of Trilight leaves as they are."""

FACE = "trilight"
PACKAGES = ("storage", "scene_templates", "pipeline", "model", "train", "infra")
"""Packages that move below FACE."""

_BUILD_FILES = ("pyproject.toml", "README.md", "LICENSE", "requirements")
"""Files that a build reads in addition to the packages."""
CHECKOUT_ONLY = ("infra/bench", "infra/pictures.py")
"""The experiments and the pictures of the documents, which wheels leave out."""
_IGNORED = shutil.ignore_patterns("__pycache__", "*.pyc", ".*")


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


def write_wheel_tree(checkout: Path, tree: Path) -> None:
    """Copy the sources of a wheel into the empty folder `tree`, with rewritten imports.

    Raises:
        SyntaxError: an import cannot be rewritten in place; the error names file and line.
    """
    for name in _BUILD_FILES:
        source = checkout / name
        copy = shutil.copytree if source.is_dir() else shutil.copy2
        copy(source, tree / name)
    shutil.copytree(checkout / FACE, tree / FACE, ignore=_IGNORED)
    for package in PACKAGES:
        shutil.copytree(checkout / package, tree / FACE / package, ignore=_IGNORED)
    for name in CHECKOUT_ONLY:
        path = tree / FACE / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    shutil.copy2(checkout / "prefect.yaml", tree / FACE)
    for path in (tree / FACE).rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        path.write_text(with_prefix(text, str(path.relative_to(tree / FACE))), encoding="utf-8")


def with_prefix(source: str, name: str = "<source>") -> str:
    """Return a module's source with `trilight.` before the packages that it imports.

    Args:
        source: source text of the module.
        name: name of the file, for messages.

    Raises:
        SyntaxError: the source is invalid, or has a statement such as `import storage.errors`,
            which binds the name `storage`, so that it cannot get a prefix: write `from storage
            import errors`.
    """
    lines = source.splitlines(keepends=True)
    for line, column in sorted(_import_positions(ast.parse(source, name), name), reverse=True):
        row = lines[line - 1].encode()  # ast counts columns in bytes
        lines[line - 1] = (row[:column] + f"{FACE}.".encode() + row[column:]).decode()
    return "".join(lines)


def _import_positions(module: ast.Module, name: str) -> Iterator[tuple[int, int]]:
    """Yield line and column of every imported name of a Trilight package."""
    for node in ast.walk(module):
        if isinstance(node, ast.ImportFrom) and node.level == 0 and _is_ours(node.module):
            yield node.lineno, node.col_offset + len("from ")
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if _is_ours(alias.name):
                    if alias.asname is None:
                        problem = f"`import {alias.name}` cannot get a prefix; use from ... import"
                        raise SyntaxError(problem, (name, alias.lineno, alias.col_offset, None))
                    yield alias.lineno, alias.col_offset


def _is_ours(name: str | None) -> bool:
    return name is not None and name.split(".")[0] in PACKAGES
