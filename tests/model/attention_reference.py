"""Attention in plain lines, to test `attention` against: slow, and obviously right."""

import math

import torch
from torch import Tensor


def attend_reference(
    q_BHQD: Tensor, k_BHND: Tensor, v_BHND: Tensor, is_key_BN: Tensor | None
) -> Tensor:
    """Return what `attention.attend` returns, scene by scene, on the keys that exist alone."""
    pictures = []
    for scene in range(len(q_BHQD)):
        keys_HND, values_HND = k_BHND[scene], v_BHND[scene]
        if is_key_BN is not None:
            keys_HND = keys_HND[:, is_key_BN[scene]]
            values_HND = values_HND[:, is_key_BN[scene]]
        scores_HQN = q_BHQD[scene] @ keys_HND.transpose(-1, -2) / math.sqrt(keys_HND.shape[-1])
        weights_HQN = scores_HQN.exp() / scores_HQN.exp().sum(dim=-1, keepdim=True)
        pictures.append(weights_HQN @ values_HND)
    return torch.stack(pictures)
