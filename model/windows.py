"""Attention in shifted windows of ray bundles (Swin, Liu et al. 2021), without a mask.

A picture's bundles are split into square windows, with attention within each. Every second layer
shifts the windows by half their width. The published code rolls the picture there and masks wrapped
neighbors; without the roll, the same windows are smaller at the borders and need no mask. Windows
of equal size are computed together.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.attention import attend


@dataclass(frozen=True, kw_only=True, eq=False)
class Windows:
    """Partition of a square picture into windows."""

    order_Q: Tensor
    """int64 indices of the bundles, window by window."""
    back_Q: Tensor
    """int64 inverse permutation of `order_Q`."""
    groups: tuple[tuple[int, int], ...]
    """Pairs (number of windows, bundles in each), in the order of `order_Q`."""


@lru_cache
def cut_windows(per_side: int, width: int, *, shifted: bool, device: torch.device) -> Windows:
    """Return the partition of per_side x per_side bundles into windows of width x width.

    Shifted windows begin at width / 2, 3 width / 2, ...; per_side is a multiple of width. The
    result depends only on these numbers, and is computed once on the CPU: on a GPU the numbers of
    windows would need a sync in every pass.
    """
    offset = width // 2 if shifted else 0
    cell_S = (np.arange(per_side) + offset) // width
    window_Q = (cell_S[:, None] * per_side + cell_S).ravel()
    _, window_Q, sizes_K = np.unique(window_Q, return_inverse=True, return_counts=True)
    order_Q = np.lexsort((window_Q, -sizes_K[window_Q]))  # larger windows first
    sizes, counts = np.unique(sizes_K, return_counts=True)
    groups = zip(counts[::-1].tolist(), sizes[::-1].tolist(), strict=True)
    return Windows(
        order_Q=_on(device, order_Q), back_Q=_on(device, order_Q.argsort()), groups=tuple(groups)
    )


@torch.inference_mode(False)
def _on(device: torch.device, indices: NDArray[np.int64]) -> Tensor:
    """Return indices on a device, usable in training even if inference cached them."""
    return torch.from_numpy(indices).to(device)


def attend_in_windows(q_MHQD: Tensor, k_MHQD: Tensor, v_MHQD: Tensor, windows: Windows) -> Tensor:
    """Return the attention [M, H, Q, D] within each window; all in the order `windows.order_Q`."""
    parts = []
    start = 0
    for count, size in windows.groups:
        inside = slice(start, start + count * size)
        q, k, v = (
            x_MHQD[:, :, inside].unflatten(2, (count, size)).transpose(1, 2).flatten(0, 1)
            for x_MHQD in (q_MHQD, k_MHQD, v_MHQD)
        )
        attended = attend(q, k, v, None).unflatten(0, (-1, count))
        parts.append(attended.transpose(1, 2).flatten(2, 3))
        start = inside.stop
    return torch.cat(parts, dim=2)
