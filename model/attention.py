"""Attention of the network; `attend_reference` of tests/model/kit.py is its slow reference.

All optimizations (kernels, precisions, packed sequences) are behind this function.

Torch picks the kernel: flash attention on CUDA in half precision without a mask, which inference
never has, and its memory-efficient one with a mask; a fused one on CPUs. A batch of several lengths
is packed if that enables flash attention too (model.packing). Alternatives were tried on a CPU
(docs/explanation): bucketed lengths take 1.1 times the time of scene after scene, jagged tensors
14, one packed sequence with a mask 8, FlexAttention 32 and it has no backward there;
variable-length attention has no CPU kernel. A single scene has no mask.
"""

import torch
from torch import Tensor
from torch.nn.functional import scaled_dot_product_attention

from model.packing import Sequences, attend_packed

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
    q, k, v = (x.transpose(1, 2) for x in (q_BHQD, k_BHND, v_BHND))
    queries = keys
    if q.shape[:2] != k.shape[:2]:
        starts_B1 = torch.arange(len(q) + 1, dtype=torch.int32, device=q.device) * q.shape[1]
        queries = Sequences(starts_B1, q.shape[1])
    attended = attend_packed(q.flatten(0, 1), k.flatten(0, 1), v.flatten(0, 1), queries, keys)
    return attended.unflatten(0, q.shape[:2]).transpose(1, 2)
