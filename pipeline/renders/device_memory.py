"""Arrays that kernels gather from, in memory that Dr.Jit allocated itself."""

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
