"""Errors of unlawful scenes: the field, its value, the expected value, the index."""

from typing import Any, NoReturn

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


ROTATION_TOLERANCE = 1e-4
"""How far a float32 rotation may be from orthonormal."""


def require_rotations(rotations: NDArray[np.float32], name: str, values: NDArray) -> None:
    """Raise TrilightError for the first of N matrices [N, 3, 3] that is no rotation."""
    rotations64 = rotations.astype(np.float64)
    gram = rotations64.transpose(0, 2, 1) @ rotations64
    is_orthonormal = abs(gram - np.eye(3)).max(axis=(1, 2)) <= ROTATION_TOLERANCE
    lawful = np.linalg.det(np.where(is_orthonormal[:, None, None], rotations64, 0)) > 0
    require_law(lawful, name, values, "an orthonormal rotation without mirroring")


def require_array(array: NDArray, name: str, dtype: type, shape: tuple[int | None, ...]) -> None:
    """Raise TrilightError unless an array has this type and shape, None being any length."""
    if array.dtype != dtype:
        broken_law(f"{name} has dtype {array.dtype}", f"{np.dtype(dtype)}")
    if array.ndim != len(shape) or any(
        expected not in (None, got) for expected, got in zip(shape, array.shape, strict=True)
    ):
        none = " with None for any length" if None in shape else ""
        broken_law(f"{name} has shape {array.shape}", f"{shape}{none}")


def broken_law(observed: str, expected: str) -> NoReturn:
    """Raise TrilightError for what was found."""
    raise TrilightError(f"scene: {observed}; expected {expected}.")


def wrong_value(name: str, got: Any, expected: str) -> NoReturn:
    """Raise TrilightError for a value from outside, of which the message shows the beginning."""
    broken_law(f"{name} is {got!r:.80}", expected)
