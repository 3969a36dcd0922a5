"""Errors of unlawful scenes: the field, its value, the expected value, the index."""

from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError


def require_law(law: NDArray[np.bool_], name: str, values: NDArray, expected: str) -> None:
    """Raise TrilightError for the first index at which `law` is false."""
    if law.all():
        return
    index = tuple(int(i) for i in np.argwhere(~law)[0])
    value = " ".join(np.array2string(values[index], threshold=16).split())
    broken_law(f"{name}{list(index)} is {value}", expected)


def broken_law(observed: str, expected: str) -> NoReturn:
    """Raise TrilightError for what was found."""
    raise TrilightError(f"scene: {observed}; expected {expected}.")
