"""Packing of sequences of several lengths without padding, for flash attention.

With a mask, torch uses its memory-efficient kernel, which is half as fast as flash attention on a
GPU. Flash attention takes no mask, but packed sequences with their start offsets. Packing and
unpacking read memory once in each direction and sum nothing: they are exact and deterministic.
"""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

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
    @staticmethod
    def forward(
        ctx: Any, x_MK: Tensor, index_P: Tensor, back_M: Tensor, exists_M: Tensor
    ) -> Tensor:
        ctx.save_for_backward(index_P, back_M, exists_M)
        return x_MK.index_select(0, index_P)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        index_P, back_M, exists_M = ctx.saved_tensors
        return _Unpack.apply(grads[0], index_P, back_M, exists_M), None, None, None


class _Unpack(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, x_PK: Tensor, index_P: Tensor, back_M: Tensor, exists_M: Tensor
    ) -> Tensor:
        ctx.save_for_backward(index_P, back_M, exists_M)
        exists = exists_M.reshape(-1, *[1] * (x_PK.ndim - 1))
        return torch.where(exists, x_PK.index_select(0, back_M), 0)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        index_P, back_M, exists_M = ctx.saved_tensors
        return _Pack.apply(grads[0], index_P, back_M, exists_M), None, None, None


def pack_tokens(x_SNK: Tensor, packing: Packing) -> Tensor:
    """Return the valid tokens: [S, N, ...] -> [P, ...]."""
    return _Pack.apply(x_SNK.flatten(0, 1), *packing[:3])


def attend_packed(
    q_QHD: Tensor, k_PHD: Tensor, v_PHD: Tensor, queries: Sequences, keys: Sequences
) -> Tensor:
    """Return softmax(q k^T / sqrt(D)) v, [Q, H, D], of each sequence to its own keys.

    Args:
        q_QHD: queries, half precision on a GPU.
        k_PHD, v_PHD: keys and values.
        queries: offsets of the queries.
        keys: offsets of the keys of the same sequences.
    """
    if q_QHD.device.type == "cuda":
        from torch.nn.attention.varlen import varlen_attn

        starts = queries.starts_S1, keys.starts_S1
        attended: Any = varlen_attn(q_QHD, k_PHD, v_PHD, *starts, queries.longest, keys.longest)
        return attended  # one tensor, where nothing else is requested
    parts = []
    spans = zip(_spans(queries.starts_S1), _spans(keys.starts_S1), strict=True)
    for (first, end), (low, high) in spans:
        q, k, v = (x.transpose(0, 1) for x in (q_QHD[first:end], k_PHD[low:high], v_PHD[low:high]))
        parts.append(scaled_dot_product_attention(q[None], k[None], v[None])[0].transpose(0, 1))
    return torch.cat(parts)


def _spans(starts_S1: Tensor) -> list[tuple[int, int]]:
    starts = starts_S1.tolist()
    return list(itertools.pairwise(starts))
