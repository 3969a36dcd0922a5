"""Scalar types of array annotations: numpy spells NDArray[X] in two ways."""

from typing import Any, get_args, get_origin

import numpy as np
from numpy.typing import NDArray


def array_scalar(hint: Any) -> Any:
    """Return X of NDArray[X], or None where an annotation is none of arrays.

    Until numpy 2.4 NDArray[X] is ndarray[shape, dtype[X]]; from 2.5 on it is an alias that keeps X.
    """
    origin = get_origin(hint)
    args = get_args(hint)
    if origin is np.ndarray:
        (scalar,) = get_args(args[1])
        return scalar
    return args[0] if origin is NDArray else None
