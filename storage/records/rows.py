"""Which rows of an array are the same, to the last bit."""

import numpy as np
from numpy.typing import NDArray


def distinct_rows(rows: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return where each distinct row first stands, in that order, and which one each row is.

    Rows [N, K] are compared by their bytes.
    """
    keys = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.shape[1] * 4))).ravel()
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first, kind="stable"), kind="stable")
    return np.sort(first), rank[inverse]
