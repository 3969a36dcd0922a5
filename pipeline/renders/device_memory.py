"""Between numpy's memory and Dr.Jit's: arrays that kernels gather from, and what comes back."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray


def own_floats(values: NDArray) -> Any:
    """Return the values, flat, as a mi.Float in Dr.Jit's own aligned memory.

    Made from numpy, an array keeps numpy's memory, and Dr.Jit compiles another kernel for each way
    in which that happens to be aligned.
    """
    flat = np.ascontiguousarray(values, np.float32).ravel()
    copy = mi.Float(flat) * dr.opaque(mi.Float, 1)  # exact, and not simplified away
    dr.eval(copy)
    return copy


def own_integers(values: NDArray) -> Any:
    """Return whole numbers from 0 as a mi.UInt32, as `own_floats` does with floats."""
    copy = mi.UInt32(np.ascontiguousarray(values, np.uint32).ravel()) + dr.opaque(mi.UInt32, 0)
    dr.eval(copy)
    return copy


def opaque_vector(values: NDArray) -> Any:
    """Return three numbers as a mi.Vector3f that is no literal in a kernel."""
    return mi.Vector3f(*(dr.opaque(mi.Float, float(value)) for value in values))


def read_back(values: Any) -> NDArray:
    """Return an array of Dr.Jit, or the components of a vector of arrays side by side, flat.

    This waits for all kernels that were launched before, so it is done where a number is needed,
    and never in between.
    """
    return np.array(dr.ravel(values))
