"""The recipe: its name, its methods and its libraries' versions; loads no mesh library."""

from pipeline.assets.settings import Decimator, Profile
from storage.errors import TrilightError
from storage.installation import installed_version

_LIBRARIES = ("embreex", "libigl", "numpy", "pymeshlab", "trimesh", "wasmtime")


def library_versions() -> dict[str, str]:
    """Return the version of each library that the mesh stage calls, or `absent`."""
    return {name: installed_version(name, "absent") for name in _LIBRARIES}


_WITH_PYMESHLAB = (
    "assets-2 embreex=4.4.0.post1 libigl=2.6.3 meshoptimizer=0.2.30a0 numpy=2.4.6 "
    "pymeshlab=2025.7.post1 trimesh=5.2.0"
)
"""Number 2, and the library versions at its start: a constant, since asset files hold it.

Raise the number (`assets-3`, without versions) when a change here or in a library gives a source
another result. `tests/pipeline/assets/test_prepare.py` fails until it does.
"""

RECIPE = _WITH_PYMESHLAB if installed_version("pymeshlab") else "assets-3 libigl"
"""Recipe name in asset files; it is part of their keys in the asset store."""

READERS = 4
"""Version of the readers' results: part of cache keys and of no asset, so that a fixed reader reads
its files again."""

_WATERTIGHT = ("libigl_qslim_alone", "meshoptimizer")


def methods_of(
    profile: Profile, decimator: Decimator = "pymeshlab", *, watertight: bool = False
) -> tuple[str, ...]:
    """Return the installed decimation methods in the order of trial; pymeshlab (GPL) is optional.

    The next one runs where one crashes its child process, or its result fails the quality checks.
    `watertight`: those that keep `faithful` meshes so.

    Raises:
        TrilightError: `uniform` without pymeshlab, the only method that makes triangles even.
    """
    if watertight and profile == "faithful":
        return _WATERTIGHT
    with_pymeshlab = installed_version("pymeshlab")
    if profile == "uniform" and not with_pymeshlab:
        raise TrilightError(
            "profile uniform: pymeshlab is not installed; run `make setup`, or use faithful."
        )
    evenly = ("pymeshlab_uniform",) if profile == "uniform" else ()
    use_pymeshlab = decimator == "pymeshlab" and with_pymeshlab
    collapse = "pymeshlab_collapse" if use_pymeshlab else "libigl_qslim"
    return (*evenly, collapse, "meshoptimizer", "meshoptimizer_sloppy")


def missing_filters() -> list[str]:
    """Return the filters that the mesh stage calls and the installed pymeshlab lacks.

    Without the system library libOpenGL.so.0, pymeshlab imports with a warning and lacks 46 of its
    filters. That is a fault of the environment, which stops a run; it must not reject every object.
    The list is empty without pymeshlab too: `methods_of` then leaves its methods out.

    The call loads the native libraries (about one second), so run it in a child process.
    """
    if not installed_version("pymeshlab"):
        return []
    from pipeline.assets.decimation.pymeshlab_filters import REQUIRED_FILTERS, pymeshlab

    present = set(pymeshlab.filter_list())
    return [name for name in REQUIRED_FILTERS if name not in present]
