"""The published parameter names, for the test that holds our network against theirs.

Their 13 x P x P texture input is 13 numbers repeated over the cells x + y <= P; summing its weights
over those cells, and its constant tangent-space normal into the bias, gives our ten columns.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from model.config import ModelConfig

TANGENT_NORMAL = torch.tensor([0.5, 0.5, 1.0], dtype=torch.float64)
"""Columns 7 to 9 of the published material, always."""


def our_names(
    published: Mapping[str, Tensor], config: ModelConfig, patch: int
) -> dict[str, Tensor]:
    """Return the tensors of a published network under our names."""
    ours = _material(published, patch)
    for mine, theirs in _table(config).items():
        for kind in ("weight", "bias"):
            if f"{theirs}.{kind}" in published:
                ours[f"{mine}.{kind}"] = published[f"{theirs}.{kind}"]
    ours["encoder.tokens.token_W"] = published["tri_token"].flatten()
    ours["encoder.registers_NW"] = published["reg_tokens"][0]
    ours["decoder.token_W"] = published["view_transformer.ray_map_patch_token"].flatten()
    return ours


def _material(published: Mapping[str, Tensor], patch: int) -> dict[str, Tensor]:
    weight = published["texture_encoder.weight"].double()
    cells = weight.unflatten(1, (13, patch, patch))
    x = torch.arange(patch)
    used = x[:, None] + x <= patch
    folded = (cells * used).sum(dim=(-2, -1))
    bias = published["texture_encoder.bias"].double() + folded[:, 7:10] @ TANGENT_NORMAL
    ten = torch.cat([folded[:, :7], folded[:, 10:]], dim=1)
    return {
        "encoder.tokens.material.weight": ten.float(),
        "encoder.tokens.material.bias": bias.float(),
    }


def _table(config: ModelConfig) -> dict[str, str]:
    table = {
        "encoder.tokens.material_norm": "texture_encoder_norm",
        "encoder.tokens.normal": "vn_encoding_proj",
        "encoder.tokens.normal_norm": "vn_encoder_norm",
        "decoder.rays": "view_transformer.ray_map_encoder",
        "decoder.rays_norm": "view_transformer.ray_map_encoder_norm",
    }
    for layer in range(config.encoder_layers):
        mine, theirs = f"encoder.layers.{layer}", f"transformer.layers.{layer}"
        table |= _ffn(mine, theirs) | _self(f"{mine}.attention", f"{theirs}.multihead_attn")
        table[f"{mine}.attention_norm"] = f"{theirs}.query_norm"
    for layer in range(config.decoder_layers):
        mine, theirs = f"decoder.layers.{layer}", f"view_transformer.transformer.layers.{layer}"
        table |= _ffn(mine, theirs) | _self(f"{mine}.self_attention", f"{theirs}.self_attn")
        table |= {
            f"{mine}.self_norm": f"{theirs}.self_attn_norm",
            f"{mine}.cross_norm": f"{theirs}.query_norm",
            f"{mine}.cross.context_norm": f"{theirs}.kv_norm",
        }
        for ours, name in (("q", "q_proj"), ("k", "k_proj"), ("v", "v_proj"), ("out", "out_proj")):
            table[f"{mine}.cross.{ours}"] = f"{theirs}.multihead_attn.{name}"
        for norm in ("q_norm", "k_norm"):
            table[f"{mine}.cross.{norm}"] = f"{theirs}.multihead_attn.{norm}"
    return table | _dpt("decoder.head", "view_transformer.out_dpt")


def _ffn(mine: str, theirs: str) -> dict[str, str]:
    return {
        f"{mine}.ffn.gate": f"{theirs}.ffn.w1",
        f"{mine}.ffn.up": f"{theirs}.ffn.w3",
        f"{mine}.ffn.down": f"{theirs}.ffn.w2",
        f"{mine}.ffn_norm": f"{theirs}.ffn_norm",
    }


def _self(mine: str, theirs: str) -> dict[str, str]:
    names = {"qkv": "in_proj", "q_norm": "q_norm", "k_norm": "k_norm", "out": "out_proj"}
    return {f"{mine}.{ours}": f"{theirs}.{name}" for ours, name in names.items()}


def _dpt(mine: str, theirs: str) -> dict[str, str]:
    table = {
        f"{mine}.halve": f"{theirs}.scratch.output_conv1",
        f"{mine}.widen": f"{theirs}.scratch.output_conv2.0",
        f"{mine}.last": f"{theirs}.scratch.output_conv2.2",
    }
    for level in range(4):
        block = f"{theirs}.scratch.refinenet{level + 1}"
        table |= {
            f"{mine}.project.{level}": f"{theirs}.projects.{level}",
            f"{mine}.resize.{level}": f"{theirs}.resize_layers.{level}",
            f"{mine}.reassemble.{level}": f"{theirs}.scratch.layer{level + 1}_rn",
            f"{mine}.fuse.{level}.project": f"{block}.out_conv",
        }
        for ours, unit in (("skip", "resConvUnit1"), ("refine", "resConvUnit2")):
            for step, conv in (("first", "conv1"), ("second", "conv2")):
                table[f"{mine}.fuse.{level}.{ours}.{step}"] = f"{block}.{unit}.{conv}"
    return table
