"""The recipe by name: its methods and what can change its results; loads no mesh library."""

from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version

from pipeline.assets.settings import Profile
from storage.errors import TrilightError

_LIBRARIES = ("embreex", "libigl", "meshoptimizer", "numpy", "pymeshlab", "trimesh")


def library_versions() -> dict[str, str]:
    """Return the version of each library that the mesh stage calls, or `absent`."""
    return {name: _installed_version(name) for name in _LIBRARIES}


def _installed_version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"


_WITH_PYMESHLAB = (
    "assets-2 embreex=4.4.0.post1 libigl=2.6.3 meshoptimizer=0.2.30a0 numpy=2.4.6 "
    "pymeshlab=2025.7.post1 trimesh=5.2.0"
)
"""Number 2, and the versions with which it began: a constant, since asset files hold it.

Where a source gives another outcome, by a change here or in a library, the next number follows:
`assets-3`, without versions. `tests/pipeline/assets/test_recipe.py` fails until it does.
"""

RECIPE = (
    _WITH_PYMESHLAB
    if _installed_version("pymeshlab") != "absent"
    else _WITH_PYMESHLAB.replace("pymeshlab=2025.7.post1", "pymeshlab=absent")
)
"""What asset files and their names in the asset store say of how they were made."""

READERS = 3
"""Number of what readers make of files: it is in the names of what caches keep, and in no asset, so
that a mended reader reads again."""

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
    if _installed_version("pymeshlab") != "absent":
        return _METHODS[profile]
    if profile == "uniform":
        raise TrilightError(
            "profile uniform: pymeshlab is not installed; run `make setup`, or use faithful."
        )
    return tuple(name for name in _METHODS[profile] if not name.startswith("pymeshlab"))
