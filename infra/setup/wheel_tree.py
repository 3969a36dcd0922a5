"""Source tree of a wheel: all packages below `trilight`, with their imports rewritten.

In a checkout `storage`, `model` and `train` are top-level packages. In a user's environment such
names would collide with other modules, so that a wheel has them as `trilight.storage` and so on, as
pip does with its vendored libraries. Only import statements change, within their line, so that line
numbers stay. Module names in strings are not rewritten: code that needs one calls
storage.installation, or uses `__package__`.

This module imports only Python's standard library, since builds run in isolated environments.
"""

import ast
import shutil
from collections.abc import Iterator
from pathlib import Path

FACE = "trilight"
PACKAGES = ("storage", "scene_templates", "pipeline", "model", "train", "infra")
"""Packages that move below FACE."""

_BUILD_FILES = ("pyproject.toml", "README.md", "LICENSE", "requirements")
"""Files that a build reads in addition to the packages."""
CHECKOUT_ONLY = ("infra/bench", "infra/pictures.py")
"""The experiments and the pictures of the documents, which wheels leave out."""
_IGNORED = shutil.ignore_patterns("__pycache__", "*.pyc", ".*")


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
