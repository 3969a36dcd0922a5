"""Attention of the network; `attend_reference` of tests/model/kit.py is its slow reference.

All optimizations (kernels, precisions, packed sequences, windows) are behind `attend` and
`attend_in_windows`.

Torch picks the kernel: flash attention on CUDA in half precision without a mask, which inference
never has, and its memory-efficient one with a mask, which is half as fast; a fused one on CPUs.
Flash attention takes no mask, but packed sequences with their start offsets, so a batch of several
lengths is packed if that enables it. Packing and unpacking read memory once in each direction and
sum nothing: they are exact and deterministic. Alternatives were tried on a CPU (docs/explanation):
bucketed lengths take 1.1 times the time of scene after scene, jagged tensors 14, one packed
sequence with a mask 8, FlexAttention 32 and it has no backward there; variable-length attention has
no CPU kernel. A single scene has no mask.

Swin windows (Liu et al. 2021) are square parts of a picture's bundles, with attention within each.
Every second layer shifts the windows by half their width. The published code rolls the picture
there and masks wrapped neighbors; without the roll, the same windows are smaller at the borders and
need no mask. Windows of equal size are computed together.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import scaled_dot_product_attention

from model.precision import REDUCED

LONGEST_STEP = 512
"""Multiple to which the longest length is rounded up, so that compiled code sees few values."""

MOST_HEAD_WIDTH = 256
"""Maximum head width of flash attention; widths are multiples of 8."""


class Sequences(NamedTuple):
    """Start offsets of S packed sequences.

    It is a named tuple, since compiled code takes its fields as inputs.
    """

    starts_S1: Tensor
    """int32 [S + 1] start offsets, and the end of the last sequence."""
    longest: int
    """Upper bound of the sequence lengths."""


class Packing(NamedTuple):
    """Index maps between S padded sequences [S, N] and their P packed tokens."""

    index_P: Tensor
    """int64 index of each packed token among the S N padded ones."""
    back_M: Tensor
    """int64 [S N] index of each padded token among the packed ones; 0 for padding."""
    exists_M: Tensor
    """bool [S N], False for padding."""
    sequences: Sequences
    """Offsets of the packed sequences."""

    def of_views(self, views: int) -> Sequences:
        """Return the offsets of all sequences repeated for each of several views."""
        starts_S1, longest = self.sequences
        total = len(self.index_P)
        first_V1 = total * torch.arange(views, dtype=torch.int32, device=starts_S1.device)[:, None]
        ends_VS = first_V1 + starts_S1[1:]
        return Sequences(torch.nn.functional.pad(ends_VS.flatten(), (1, 0)), longest)


def pack_lengths(lengths: Sequence[int], longest: int, device: torch.device) -> Packing:
    """Return the packing of sequences whose first `lengths[s]` of `longest` tokens are valid."""
    total = sum(lengths)
    count = len(lengths)
    lengths_S = torch.tensor(lengths, device=device)
    starts_S1 = torch.nn.functional.pad(lengths_S.cumsum(0), (1, 0))
    row_P = torch.repeat_interleave(
        torch.arange(count, device=device), lengths_S, output_size=total
    )
    place_P = torch.arange(total, device=device) - starts_S1[row_P]
    place_N = torch.arange(longest, device=device)
    exists_SN = place_N < lengths_S[:, None]
    back_SN = (starts_S1[:-1, None] + place_N) * exists_SN
    return Packing(
        index_P=row_P * longest + place_P,
        back_M=back_SN.flatten(),
        exists_M=exists_SN.flatten(),
        sequences=Sequences(
            starts_S1=starts_S1.int(), longest=-(-max(lengths) // LONGEST_STEP) * LONGEST_STEP
        ),
    )


def supports_packed(x: Tensor, head_width: int) -> bool:
    """Return whether packed attention is faster for a tensor's device and type.

    Torch's kernel is for GPUs and half precision; elsewhere masks are as fast.
    """
    device = x.device.type
    reduced = x.dtype in REDUCED or (device == "cuda" and torch.is_autocast_enabled("cuda"))
    return device == "cuda" and reduced and head_width % 8 == 0 and head_width <= MOST_HEAD_WIDTH


class _Pack(torch.autograd.Function):
    """Packed tokens of padded ones; the backward pass is a lookup too, and sums nothing."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, index_P: Tensor, *back: Tensor) -> Tensor:
        ctx.save_for_backward(*back)
        return x.index_select(0, index_P)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        back_M, exists_M = ctx.saved_tensors
        exists = exists_M.reshape(-1, *[1] * (grads[0].ndim - 1))
        return torch.where(exists, grads[0].index_select(0, back_M), 0), None, None, None


def pack_tokens(x_SNK: Tensor, packing: Packing) -> Tensor:
    """Return the valid tokens: [S, N, ...] -> [P, ...]."""
    return _Pack.apply(x_SNK.flatten(0, 1), *packing[:3])


Keys = Tensor | Sequences | None
"""Valid keys: bool [B, N], False for padding; or the starts of packed sequences; None for all."""


def attend(q_BHQD: Tensor, k_BHND: Tensor, v_BHND: Tensor, keys: Keys) -> Tensor:
    """Return softmax(q k^T / sqrt(D)) v, [B, H, Q, D], over the keys that exist.

    Args:
        q_BHQD, k_BHND, v_BHND: one floating dtype.
        keys: valid keys. A mask reaches the kernel as [B, 1, 1, N]: expanded to every query and
            head it would double the time. Each row needs at least one key. For sequences, keys are
            packed rows; queries are packed too, or B equal sequences.
    """
    if isinstance(keys, Sequences):
        return _attend_sequences(q_BHQD, k_BHND, v_BHND, keys)
    mask = None if keys is None else keys[:, None, None, :]
    return scaled_dot_product_attention(q_BHQD, k_BHND, v_BHND, attn_mask=mask)


def _attend_sequences(q_BHQD: Tensor, k_BHND: Tensor, v_BHND: Tensor, keys: Sequences) -> Tensor:
    from torch.nn.attention.varlen import varlen_attn  # of GPUs alone

    q, k, v = (x.transpose(1, 2) for x in (q_BHQD, k_BHND, v_BHND))
    shape = q.shape[:2]
    queries = keys
    if shape != k.shape[:2]:
        starts_B1 = torch.arange(shape[0] + 1, dtype=torch.int32, device=q.device) * shape[1]
        queries = Sequences(starts_B1, shape[1])
    q, k, v = (x.flatten(0, 1) for x in (q, k, v))
    starts = queries.starts_S1, keys.starts_S1
    attended: Any = varlen_attn(q, k, v, *starts, queries.longest, keys.longest)
    return attended.unflatten(0, shape).transpose(1, 2)  # one tensor, as nothing else is asked


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
@torch.inference_mode(False)  # training may use what inference has cached
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
    order, back = (torch.from_numpy(each).to(device) for each in (order_Q, order_Q.argsort()))
    return Windows(order_Q=order, back_Q=back, groups=tuple(groups))


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
