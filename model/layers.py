"""Transformer blocks of both stages: self-attention, cross-attention and SwiGLU after RMSNorms.

There are no biases. Queries and keys are normalized over the full width, before the split into
heads and before the rotation, which keeps their products bounded while training.
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from model.attention import Keys, Windows, attend, attend_in_windows
from model.positions import KeysValues, Rotation, rotate
from model.precision import rounded_call, rounded_weights, without_autocast

LAYER_NORM_EPS = 1e-6
"""Epsilon of every norm inside a layer, as published."""

TOKEN_NORM_EPS = 1.1920929e-07
"""Epsilon of the norms that make tokens: float32's machine epsilon, as published."""


class Norm(nn.RMSNorm):
    """RMSNorm whose result has the type of its input, independent of the type of its weight.

    Under autocast the two differ, and torch would not use its fused kernel. On CUDA, autocast would
    also return float32, and all later operations would compute in it.
    """

    def forward(self, x: Tensor) -> Tensor:
        """[..., W] -> [..., W]."""
        assert self.weight is not None
        weight = self.weight.to(x.dtype)
        with without_autocast(x.device):
            return nn.functional.rms_norm(x, self.normalized_shape, weight, self.eps)


def dtype_of(layers: nn.ModuleList) -> torch.dtype:
    """Return the type of the layers' weights, in which they compute."""
    return next(layers.parameters()).dtype


def run_layer(layer: nn.Module, *inputs: object, recompute: bool) -> Any:
    """Return layer(*inputs); `recompute` keeps no activations for the backward pass.

    They are then computed a second time (Chen et al. 2016): the same gradients, for less memory and
    about a third more time.
    """
    (device,) = {each.device for each in inputs if isinstance(each, Tensor)}
    weights = rounded_weights(layer, device)
    if recompute and torch.is_grad_enabled():
        return checkpoint(rounded_call, layer, weights, *inputs, use_reentrant=False)
    return rounded_call(layer, weights, *inputs)


def split_heads(x_BNW: Tensor, num_heads: int) -> Tensor:
    """[B, N, W] -> [B, H, N, D]."""
    return x_BNW.unflatten(-1, (num_heads, -1)).transpose(-2, -3)


def merge_heads(x_BHND: Tensor) -> Tensor:
    """[B, H, N, D] -> [B, N, W]."""
    return x_BHND.transpose(-2, -3).flatten(-2)


class SwiGLU(nn.Module):
    """down(silu(gate x) * up x) (Shazeer 2020, equation 6)."""

    def __init__(self, width: int, hidden_width: int) -> None:
        super().__init__()
        self.gate = nn.Linear(width, hidden_width, bias=False)
        self.up = nn.Linear(width, hidden_width, bias=False)
        self.down = nn.Linear(hidden_width, width, bias=False)

    def forward(self, x_BNW: Tensor) -> Tensor:
        """[B, N, W] -> [B, N, W].

        On a GPU gate and up are one product, which reads x only once in each pass.
        """
        if x_BNW.device.type != "cuda":
            return self.down(nn.functional.silu(self.gate(x_BNW)) * self.up(x_BNW))
        both = nn.functional.linear(x_BNW, torch.cat([self.gate.weight, self.up.weight]))
        gate, up = both.chunk(2, dim=-1)
        return self.down(nn.functional.silu(gate) * up)


class SelfAttention(nn.Module):
    """Self-attention of a sequence, with or without rotary positions."""

    def __init__(self, width: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.qkv = nn.Linear(width, 3 * width, bias=False)
        self.q_norm = Norm(width, eps=LAYER_NORM_EPS)
        self.k_norm = Norm(width, eps=LAYER_NORM_EPS)
        self.out = nn.Linear(width, width, bias=False)

    def forward(
        self,
        x_BNW: Tensor,
        *,
        rotation: Rotation | None = None,
        keys: Keys = None,
        windows: Windows | None = None,
    ) -> Tensor:
        """[B, N, W] -> [B, N, W].

        `rotation` is None if all positions are the origin; `windows` splits the sequence into
        windows without attention between them, and excludes the other two.
        """
        if windows is not None:
            x_BNW = x_BNW[:, windows.order_Q]
        q_BNW, k_BNW, v_BNW = self.qkv(x_BNW).chunk(3, dim=-1)
        q_BHND = split_heads(self.q_norm(q_BNW), self.num_heads)
        k_BHND = split_heads(self.k_norm(k_BNW), self.num_heads)
        v_BHND = split_heads(v_BNW, self.num_heads)
        if rotation is not None:
            q_BHND = rotate(q_BHND, *rotation)
            k_BHND = rotate(k_BHND, *rotation)
        if windows is None:
            return self.out(merge_heads(attend(q_BHND, k_BHND, v_BHND, keys)))
        attended_BNW = merge_heads(attend_in_windows(q_BHND, k_BHND, v_BHND, windows))
        return self.out(attended_BNW)[:, windows.back_Q]


class CrossAttention(nn.Module):
    """Cross-attention of ray bundles to the tokens of their scene.

    Keys and values are projected once per scene, and keys are rotated once per view, which encodes
    the camera. Queries are at the camera's origin, where the rotation is the identity.
    """

    def __init__(self, width: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.context_norm = Norm(width, eps=LAYER_NORM_EPS)
        self.q = nn.Linear(width, width, bias=False)
        self.k = nn.Linear(width, width, bias=False)
        self.v = nn.Linear(width, width, bias=False)
        self.q_norm = Norm(width, eps=LAYER_NORM_EPS)
        self.k_norm = Norm(width, eps=LAYER_NORM_EPS)
        self.out = nn.Linear(width, width, bias=False)

    def keys_values(self, context_BNW: Tensor) -> KeysValues:
        """Return unrotated keys, and values, of a context: once per scene."""
        normed_BNW = self.context_norm(context_BNW)
        k_BHND = split_heads(self.k_norm(self.k(normed_BNW)), self.num_heads)
        return k_BHND, split_heads(self.v(normed_BNW), self.num_heads)

    def forward(
        self, x_BVQW: Tensor, keys_values: KeysValues, rotation_BVNA: Rotation, keys: Keys
    ) -> Tensor:
        """[B, V, Q, W] -> [B, V, Q, W]; `keys` are those of scenes, or packed for each view."""
        num_views = x_BVQW.shape[1]
        k_BHND, v_BHND = keys_values
        k_BVHND = rotate(k_BHND[:, None], *rotation_BVNA)
        v_BVHND = v_BHND[:, None].expand_as(k_BVHND)
        q_BVHQD = split_heads(self.q_norm(self.q(x_BVQW)), self.num_heads)
        if isinstance(keys, Tensor):
            keys = keys.repeat_interleave(num_views, dim=0)
        attended = attend(q_BVHQD.flatten(0, 1), k_BVHND.flatten(0, 1), v_BVHND.flatten(0, 1), keys)
        return self.out(merge_heads(attended)).unflatten(0, x_BVQW.shape[:2])


class EncoderLayer(nn.Module):
    """Self-attention of all tokens of a scene, then SwiGLU, each added to the residual stream.

    The last addition is left to the next layer: compiled, it adds and normalizes in one kernel, and
    reads the stream once instead of twice.
    """

    def __init__(self, width: int, num_heads: int, hidden_width: int) -> None:
        super().__init__()
        self.attention_norm = Norm(width, eps=LAYER_NORM_EPS)
        self.attention = SelfAttention(width, num_heads)
        self.ffn_norm = Norm(width, eps=LAYER_NORM_EPS)
        self.ffn = SwiGLU(width, hidden_width)

    def forward(
        self, x_BNW: Tensor, due_BNW: Tensor | None, rotation: Rotation, keys: Keys
    ) -> tuple[Tensor, Tensor]:
        """Return the stream [B, N, W], and the pending term that the next layer adds.

        `due_BNW` is the pending term of the previous layer; None in the first layer.
        """
        if due_BNW is not None:
            x_BNW = x_BNW + due_BNW
        x_BNW = x_BNW + self.attention(self.attention_norm(x_BNW), rotation=rotation, keys=keys)
        return x_BNW, self.ffn(self.ffn_norm(x_BNW))


class DecoderLayer(nn.Module):
    """Cross-attention to the scene, self-attention within the view, then SwiGLU."""

    def __init__(self, width: int, num_heads: int, hidden_width: int) -> None:
        super().__init__()
        self.cross_norm = Norm(width, eps=LAYER_NORM_EPS)
        self.cross = CrossAttention(width, num_heads)
        self.self_norm = Norm(width, eps=LAYER_NORM_EPS)
        self.self_attention = SelfAttention(width, num_heads)
        self.ffn_norm = Norm(width, eps=LAYER_NORM_EPS)
        self.ffn = SwiGLU(width, hidden_width)

    def forward(
        self,
        x_BVQW: Tensor,
        keys_values: KeysValues,
        rotation_BVNA: Rotation,
        keys: Keys,
        windows: Windows | None,
    ) -> Tensor:
        """[B, V, Q, W] -> [B, V, Q, W]; `keys_values` are those of this layer's `cross`."""
        views = x_BVQW.shape[:2]
        x_BVQW = x_BVQW + self.cross(self.cross_norm(x_BVQW), keys_values, rotation_BVNA, keys)
        x_MQW = torch.flatten(x_BVQW, 0, 1)
        x_MQW = x_MQW + self.self_attention(self.self_norm(x_MQW), windows=windows)
        return (x_MQW + self.ffn(self.ffn_norm(x_MQW))).unflatten(0, views)
