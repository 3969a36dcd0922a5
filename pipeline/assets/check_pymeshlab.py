"""Checks that the installed pymeshlab has the filters that the mesh stage calls.

Without the system library libOpenGL.so.0, pymeshlab imports with a warning and lacks 46 of its
filters. That is a fault of the environment, which stops a run; it must not reject every object.
"""

from importlib.util import find_spec


def missing_filters() -> list[str]:
    """Return the filters that this stage calls and the installed pymeshlab lacks.

    The list is empty without pymeshlab too: `recipe.methods_of` then leaves its methods out.

    The call loads the native libraries (about one second), so run it in a child process.
    """
    if find_spec("pymeshlab") is None:
        return []
    from pipeline.assets.decimation.pymeshlab_filters import REQUIRED_FILTERS, pymeshlab

    present = set(pymeshlab.filter_list())
    return [name for name in REQUIRED_FILTERS if name not in present]
