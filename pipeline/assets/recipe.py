"""The recipe by name: its methods and what can change its results; loads no mesh library."""

import ast
import functools
import hashlib
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from pipeline.assets.settings import Profile
from storage.errors import TrilightError

_LIBRARIES = ("embreex", "libigl", "meshoptimizer", "numpy", "pymeshlab", "trimesh")


def _installed(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"


RECIPE = " ".join(["assets-2", *(f"{name}={_installed(name)}" for name in _LIBRARIES)])
"""The number advances by hand whenever the same source would give other bytes."""

_METHODS: Mapping[Profile, tuple[str, ...]] = {
    "faithful": ("pymeshlab_collapse", "meshoptimizer", "meshoptimizer_sloppy"),
    "uniform": (
        "pymeshlab_uniform",
        "pymeshlab_collapse",
        "meshoptimizer",
        "meshoptimizer_sloppy",
    ),
}
"""Decimations in the order in which they are tried: the next where one kills its child, or where
its result fails the gate."""


def methods_of(profile: Profile) -> tuple[str, ...]:
    """Return the methods of a profile that are installed: pymeshlab (GPL) may be left out.

    Raises:
        TrilightError: `uniform` without pymeshlab, since nothing else here makes triangles even.
    """
    if _installed("pymeshlab") != "absent":
        return _METHODS[profile]
    if profile == "uniform":
        raise TrilightError(
            "profile uniform: pymeshlab is not installed; run `make setup`, or use faithful."
        )
    return tuple(name for name in _METHODS[profile] if not name.startswith("pymeshlab"))


@functools.cache
def code_sha256(folder: Path = Path(__file__).parent) -> str:
    """Return the digest of this stage's own source: another program may give another outcome.

    Import statements are left out: they say where things are, not what they do, and differ between
    a checkout and a wheel.
    """
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        digest.update(_without_imports(path.read_bytes()))
    return digest.hexdigest()


def _without_imports(source: bytes) -> bytes:
    lines = source.splitlines(keepends=True)
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            for number in range(node.lineno - 1, node.end_lineno or node.lineno):
                lines[number] = b""
    return b"".join(lines)
