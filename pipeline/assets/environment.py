"""Whether this machine's pymeshlab can do what we ask of it.

Without the system library libOpenGL.so.0, pymeshlab imports with a warning and lacks 46 of its
filters. That is a fault of the environment, which stops a run; it must not reject every object.
"""

import pymeshlab

from pipeline.assets.decimation import REQUIRED_FILTERS


def missing_filters() -> list[str]:
    """Return the filters that this stage calls and pymeshlab does not have; empty when all is well.

    Importing this module loads the native libraries (about one second), so ask in a child process.
    """
    present = set(pymeshlab.filter_list())
    return [name for name in REQUIRED_FILTERS if name not in present]
