"""The recipe by name: its methods and what can change its results; loads no mesh library."""

import functools
import hashlib
import re
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


_IMPORT = re.compile(
    rb"^[ \t]*(?:from [\w.]+ import (?:\([^)]*\)|[^\n]*)|import [^\n]*)\n", re.MULTILINE
)
"""A statement as ruff writes it. Python 3.11's `ast` fails now and then where threads parse."""


_HERE = Path(__file__).parent


@functools.cache
def code_sha256(*folders: Path) -> str:
    """Return the digest of this stage's own source: another program may give another outcome.

    By default that is this folder and the one that reads USD.

    Import statements are left out: they say where things are, not what they do, and differ between
    a checkout and a wheel.
    """
    digest = hashlib.sha256()
    for folder in folders or (_HERE, _HERE.parent / "usd"):
        for path in sorted(folder.rglob("*.py")):
            digest.update(_IMPORT.sub(b"", path.read_bytes()))
    return digest.hexdigest()
