"""The one attention function of the network; tests/model/attention_reference.py is its slow twin.

Everything that may later be faster (kernels, precisions, packed sequences) goes behind this
signature, so that nothing above it knows.

Torch picks the kernel: flash attention on CUDA in half precision without a mask, which inference
never has, and its memory-efficient one with a mask; a fused one on CPUs. Alternatives were tried on
a CPU (docs/explanation): lengths evened out by buckets take 1.1 times what scene after scene does,
jagged tensors 14, one packed sequence with a mask 8, FlexAttention 32 and it has no backward there;
variable-length attention has no CPU kernel. A scene alone has no mask.
"""

from torch import Tensor
from torch.nn.functional import scaled_dot_product_attention


def attend(q_BHQD: Tensor, k_BHND: Tensor, v_BHND: Tensor, is_key_BN: Tensor | None) -> Tensor:
    """Return softmax(q k^T / sqrt(D)) v, [B, H, Q, D], over the keys that exist.

    Args:
        q_BHQD, k_BHND, v_BHND: one floating dtype.
        is_key_BN: bool, False for padding; None where every key exists. It reaches the kernel as
            [B, 1, 1, N]: spelled out for every query and head it would double the time. Each row
            needs at least one key.
    """
    mask = None if is_key_BN is None else is_key_BN[:, None, None, :]
    return scaled_dot_product_attention(q_BHQD, k_BHND, v_BHND, attn_mask=mask)
