"""Conversion between tensors under published names and our networks.

All layers but one are copied under another name. The published material encoder reads a 13 x P x P
texture. Its input is always the same 13 numbers in every cell (x, y) with x + y <= P, and zero
elsewhere, and three of them, the tangent-space normal, are always (0.5, 0.5, 1). So its weights are
summed over those cells, and the normal's contribution is added to the bias: the same function at a
thousandth of the input and 10 million fewer weights (P = 32).
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from model.config import NUM_TAPS, ModelConfig
from model.published.config import PublishedConfig
from model.renderformer import RenderFormer
from model.weights import network_of, require_tensors
from storage.errors import TrilightError

FREQUENCY_TOLERANCE = 1e-6
"""Maximum relative difference of stored frequencies from the formula: float32's rounding."""


def load_published(tensors: Mapping[str, Tensor], config: PublishedConfig) -> RenderFormer:
    """Return the network of published tensors, float32, in evaluation mode on the CPU.

    Raises:
        TrilightError: names or shapes do not match the configuration (all are listed), or the
            rotary frequencies do not.
    """
    with torch.device("meta"):
        expected = to_published(RenderFormer(config.model), config.texture_patch)
    require_tensors(tensors, expected)
    single = {name: tensor.float() for name, tensor in tensors.items()}
    weight, bias = fold(
        single[f"{TEXTURE}.weight"], single[f"{TEXTURE}.bias"], config.texture_patch
    )
    state = {
        "encoder.tokens.material.weight": weight,
        "encoder.tokens.material.bias": bias,
        "encoder.tokens.token_W": single[TRIANGLE_TOKEN][0, 0],
        "encoder.registers_NW": single[REGISTERS][0],
        "decoder.token_W": single[BUNDLE_TOKEN][0, 0],
    }
    for ours, theirs in module_names(config.model).items():
        for kind in ("weight", "bias"):
            if f"{theirs}.{kind}" in single:
                state[f"{ours}.{kind}"] = single[f"{theirs}.{kind}"]
    model = network_of(config.model, state)
    for name in FREQUENCIES:
        _require_frequencies(name, single[name], model.encoder.rotary.freqs_F)
    return model


def to_published(model: RenderFormer, texture_patch: int) -> dict[str, Tensor]:
    """Return a network's tensors under published names, with the texture encoder unfolded.

    Reading them back gives exactly the same network.
    """
    state = model.state_dict()
    material = "encoder.tokens.material"
    weight, bias = unfold(state[f"{material}.weight"], state[f"{material}.bias"], texture_patch)
    published = {
        f"{TEXTURE}.weight": weight,
        f"{TEXTURE}.bias": bias,
        **{name: model.encoder.rotary.freqs_F.clone() for name in FREQUENCIES},
        TRIANGLE_TOKEN: state["encoder.tokens.token_W"][None, None],
        REGISTERS: state["encoder.registers_NW"][None],
        BUNDLE_TOKEN: state["decoder.token_W"][None, None],
    }
    for ours, theirs in module_names(model.config).items():
        for kind in ("weight", "bias"):
            if f"{ours}.{kind}" in state:
                published[f"{theirs}.{kind}"] = state[f"{ours}.{kind}"]
    return published


def _require_frequencies(name: str, got_F: Tensor, expected_F: Tensor) -> None:
    if not torch.allclose(got_F, expected_F, rtol=FREQUENCY_TOLERANCE, atol=0):
        raise TrilightError(
            f"published weights: {name} is {got_F.tolist()}, but the configuration means "
            f"{expected_F.tolist()}; expected a config.json that belongs to these weights."
        )


TEXTURE = "texture_encoder"
"""Published name of the layer that is folded and not copied (`fold`)."""

FREQUENCIES = ("transformer.rope_emb.freqs", "view_transformer.transformer.rope_emb.freqs")
"""Published names of the rotary frequencies of both stages, which our configuration determines."""

TRIANGLE_TOKEN = "tri_token"
REGISTERS = "reg_tokens"
BUNDLE_TOKEN = "view_transformer.ray_map_patch_token"
"""The learned vectors; the published ones have leading dimensions of size 1."""

_VIEW = "view_transformer"


def module_names(config: ModelConfig) -> dict[str, str]:
    """Return the published name of every layer with weights by our name, without the material's."""
    table = {
        "encoder.tokens.material_norm": f"{TEXTURE}_norm",
        "encoder.tokens.normal": "vn_encoding_proj",
        "encoder.tokens.normal_norm": "vn_encoder_norm",
        "decoder.rays": f"{_VIEW}.ray_map_encoder",
        "decoder.rays_norm": f"{_VIEW}.ray_map_encoder_norm",
    }
    for layer in range(config.encoder_layers):
        table |= _encoder_layer(f"encoder.layers.{layer}", f"transformer.layers.{layer}")
    for layer in range(config.decoder_layers):
        table |= _decoder_layer(f"decoder.layers.{layer}", f"{_VIEW}.transformer.layers.{layer}")
    return table | _dpt("decoder.head", f"{_VIEW}.out_dpt")


_SELF_ATTENTION = {"qkv": "in_proj", "q_norm": "q_norm", "k_norm": "k_norm", "out": "out_proj"}
_CROSS_ATTENTION = {
    "q": "q_proj", "k": "k_proj", "v": "v_proj", "out": "out_proj",
    "q_norm": "q_norm", "k_norm": "k_norm",
}  # fmt: skip
_FFN = {"ffn.gate": "ffn.w1", "ffn.up": "ffn.w3", "ffn.down": "ffn.w2", "ffn_norm": "ffn_norm"}


def _below(ours: str, theirs: str, names: Mapping[str, str]) -> dict[str, str]:
    return {f"{ours}.{a}": f"{theirs}.{b}" for a, b in names.items()}


def _encoder_layer(ours: str, theirs: str) -> dict[str, str]:
    return {
        **_below(f"{ours}.attention", f"{theirs}.multihead_attn", _SELF_ATTENTION),
        **_below(ours, theirs, {"attention_norm": "query_norm", **_FFN}),
    }


def _decoder_layer(ours: str, theirs: str) -> dict[str, str]:
    norms = {
        "cross.context_norm": "kv_norm", "cross_norm": "query_norm", "self_norm": "self_attn_norm",
    }  # fmt: skip
    return {
        **_below(f"{ours}.self_attention", f"{theirs}.self_attn", _SELF_ATTENTION),
        **_below(f"{ours}.cross", f"{theirs}.multihead_attn", _CROSS_ATTENTION),
        **_below(ours, theirs, norms | _FFN),
    }


def _dpt(ours: str, theirs: str) -> dict[str, str]:
    scratch = f"{theirs}.scratch"
    table = {
        f"{ours}.halve": f"{scratch}.output_conv1",
        f"{ours}.widen": f"{scratch}.output_conv2.0",
        f"{ours}.last": f"{scratch}.output_conv2.2",
    }
    for level in range(NUM_TAPS):
        fuse = f"{ours}.fuse.{level}"
        block = f"{scratch}.refinenet{level + 1}"
        table |= {
            f"{ours}.project.{level}": f"{theirs}.projects.{level}",
            f"{ours}.resize.{level}": f"{theirs}.resize_layers.{level}",
            f"{ours}.reassemble.{level}": f"{scratch}.layer{level + 1}_rn",
            f"{fuse}.project": f"{block}.out_conv",
        }
        for a, b in (("skip", "resConvUnit1"), ("refine", "resConvUnit2")):
            table |= {
                f"{fuse}.{a}.first": f"{block}.{b}.conv1",
                f"{fuse}.{a}.second": f"{block}.{b}.conv2",
            }
    return table


TEXTURE_CHANNELS = 13
NORMAL = slice(7, 10)
"""The tangent-space normal among diffuse 3, specular 3, roughness 1, normal 3, emission 3."""

TANGENT_NORMAL = (0.5, 0.5, 1.0)


def fold(weight_WC: Tensor, bias_W: Tensor, patch: int) -> tuple[Tensor, Tensor]:
    """Return weight [W, 10] and bias [W] for the published weight [W, 13 P P] and bias.

    It sums in float64, and returns the type of its inputs.
    """
    cells = weight_WC.double().unflatten(1, (TEXTURE_CHANNELS, patch, patch))
    place = torch.arange(patch, device=weight_WC.device)
    thirteen = (cells * (place[:, None] + place <= patch)).sum(dim=(-2, -1))
    normal = torch.tensor(TANGENT_NORMAL, dtype=torch.float64, device=weight_WC.device)
    bias = bias_W.double() + (thirteen[:, NORMAL] * normal).sum(dim=1)
    ten = torch.cat([thirteen[:, : NORMAL.start], thirteen[:, NORMAL.stop :]], dim=1)
    return ten.to(weight_WC.dtype), bias.to(bias_W.dtype)


def unfold(weight_WC: Tensor, bias_W: Tensor, patch: int) -> tuple[Tensor, Tensor]:
    """Return a published weight [W, 13 P P] and bias that `fold` converts exactly to these.

    The sum cannot be undone: the whole weight is in the first cell, and the normal's columns are
    zero.
    """
    cells = weight_WC.new_zeros((len(weight_WC), TEXTURE_CHANNELS, patch, patch))
    cells[:, : NORMAL.start, 0, 0] = weight_WC[:, : NORMAL.start]
    cells[:, NORMAL.stop :, 0, 0] = weight_WC[:, NORMAL.start :]
    return cells.flatten(1), bias_W.clone()
