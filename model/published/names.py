"""What the published checkpoints call each part of the network, beside what we call it."""

from model.config import NUM_TAPS, ModelConfig

TEXTURE = "texture_encoder"
"""The one layer that is not copied but folded: `published.texture`."""

FREQUENCIES = ("transformer.rope_emb.freqs", "view_transformer.transformer.rope_emb.freqs")
"""Rotary frequencies of both stages, frozen and equal; ours follow from the configuration."""

TRIANGLE_TOKEN = "tri_token"
REGISTERS = "reg_tokens"
BUNDLE_TOKEN = "view_transformer.ray_map_patch_token"
"""The learned vectors; the published ones have leading dimensions of size 1."""

_VIEW = "view_transformer"


def module_names(config: ModelConfig) -> dict[str, str]:
    """Return our name -> published name of every layer that has weights, but the material's."""
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


def _encoder_layer(ours: str, theirs: str) -> dict[str, str]:
    return {
        **_self_attention(f"{ours}.attention", f"{theirs}.multihead_attn"),
        f"{ours}.attention_norm": f"{theirs}.query_norm",
        **_ffn(ours, theirs),
    }


def _decoder_layer(ours: str, theirs: str) -> dict[str, str]:
    cross = {
        "q": "q_proj", "k": "k_proj", "v": "v_proj", "out": "out_proj",
        "q_norm": "q_norm", "k_norm": "k_norm",
    }  # fmt: skip
    return {
        **_self_attention(f"{ours}.self_attention", f"{theirs}.self_attn"),
        **{f"{ours}.cross.{a}": f"{theirs}.multihead_attn.{b}" for a, b in cross.items()},
        f"{ours}.cross.context_norm": f"{theirs}.kv_norm",
        f"{ours}.cross_norm": f"{theirs}.query_norm",
        f"{ours}.self_norm": f"{theirs}.self_attn_norm",
        **_ffn(ours, theirs),
    }


def _self_attention(ours: str, theirs: str) -> dict[str, str]:
    names = {"qkv": "in_proj", "q_norm": "q_norm", "k_norm": "k_norm", "out": "out_proj"}
    return {f"{ours}.{a}": f"{theirs}.{b}" for a, b in names.items()}


def _ffn(ours: str, theirs: str) -> dict[str, str]:
    names = {"ffn.gate": "ffn.w1", "ffn.up": "ffn.w3", "ffn.down": "ffn.w2", "ffn_norm": "ffn_norm"}
    return {f"{ours}.{a}": f"{theirs}.{b}" for a, b in names.items()}


def _dpt(ours: str, theirs: str) -> dict[str, str]:
    scratch = f"{theirs}.scratch"
    table = {
        f"{ours}.halve": f"{scratch}.output_conv1",
        f"{ours}.widen": f"{scratch}.output_conv2.0",
        f"{ours}.last": f"{scratch}.output_conv2.2",
    }
    for level in range(NUM_TAPS):
        fuse, block = f"{ours}.fuse.{level}", f"{scratch}.refinenet{level + 1}"
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
