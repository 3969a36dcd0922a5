"""The one attention function of the network; tests/model/attention_reference.py is its slow twin.

Everything that may later be faster (kernels, precisions, packed sequences) goes behind this
signature, so that nothing above it knows.

Torch picks the kernel: flash attention on CUDA in half precision without a mask, which inference
never has, and its memory-efficient one with a mask; a fused one on CPUs. A batch of several lengths
is packed where that gives it flash attention too (model.packing). Alternatives were tried on
a CPU (docs/explanation): lengths evened out by buckets take 1.1 times what scene after scene does,
jagged tensors 14, one packed sequence with a mask 8, FlexAttention 32 and it has no backward there;
variable-length attention has no CPU kernel. A scene alone has no mask.
"""

import torch
from torch import Tensor
from torch.nn.functional import scaled_dot_product_attention

from model.packing import Sequences, attend_packed

Keys = Tensor | Sequences | None
"""Which keys exist: bool [B, N], False for padding; where they lie one after the other; None: all
do."""


def attend(q_BHQD: Tensor, k_BHND: Tensor, v_BHND: Tensor, keys: Keys) -> Tensor:
    """Return softmax(q k^T / sqrt(D)) v, [B, H, Q, D], over the keys that exist.

    Args:
        q_BHQD, k_BHND, v_BHND: one floating dtype.
        keys: which exist. A mask reaches the kernel as [B, 1, 1, N]: spelled out for every query
            and head it would double the time. Each row needs at least one key. Of sequences, keys
            are rows of them one after the other; queries are those too, or B equal sequences.
    """
    if isinstance(keys, Sequences):
        return _packed(q_BHQD, k_BHND, v_BHND, keys)
    mask = None if keys is None else keys[:, None, None, :]
    return scaled_dot_product_attention(q_BHQD, k_BHND, v_BHND, attn_mask=mask)


def _packed(q_BHQD: Tensor, k_BHND: Tensor, v_BHND: Tensor, keys: Sequences) -> Tensor:
    q, k, v = (x.transpose(1, 2) for x in (q_BHQD, k_BHND, v_BHND))
    asks = keys
    if q.shape[:2] != k.shape[:2]:
        starts_B1 = torch.arange(len(q) + 1, dtype=torch.int32, device=q.device) * q.shape[1]
        asks = Sequences(starts_B1, q.shape[1])
    found = attend_packed(q.flatten(0, 1), k.flatten(0, 1), v.flatten(0, 1), asks, keys)
    return found.unflatten(0, q.shape[:2]).transpose(1, 2)
