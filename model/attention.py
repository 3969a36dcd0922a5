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

from model.packing import Packing, attend_packed, packed

Keys = Tensor | Packing | None
"""Which keys exist: bool [B, N], False for padding; where they are packed; None: all do."""


def attend(q_BHQD: Tensor, k_BHND: Tensor, v_BHND: Tensor, keys: Keys) -> Tensor:
    """Return softmax(q k^T / sqrt(D)) v, [B, H, Q, D], over the keys that exist.

    Args:
        q_BHQD, k_BHND, v_BHND: one floating dtype.
        keys: which exist. A mask reaches the kernel as [B, 1, 1, N]: spelled out for every query
            and head it would double the time. Each row needs at least one key. Of a packing, the B
            sequences are either padded here, or B is 1 and they follow each other.
    """
    if isinstance(keys, Packing):
        return _packed(q_BHQD, k_BHND, v_BHND, keys)
    mask = None if keys is None else keys[:, None, None, :]
    return scaled_dot_product_attention(q_BHQD, k_BHND, v_BHND, attn_mask=mask)


def _packed(q_BHQD: Tensor, k_BHND: Tensor, v_BHND: Tensor, keys: Packing) -> Tensor:
    q, k, v = (x.transpose(1, 2) for x in (q_BHQD, k_BHND, v_BHND))
    if k.shape[0] * k.shape[1] == len(keys.index_P):  # packed already, and so are the queries
        asks, longest, k, v = keys.starts_S1, keys.longest, k.flatten(0, 1), v.flatten(0, 1)
    else:
        longest = q.shape[1]
        asks = torch.arange(len(q) + 1, dtype=torch.int32, device=q.device) * longest
        k, v = packed(k, keys), packed(v, keys)
    found = attend_packed(q.flatten(0, 1), k, v, asks, longest, keys)
    return found.unflatten(0, q.shape[:2]).transpose(1, 2)
