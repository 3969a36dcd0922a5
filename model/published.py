"""Published RenderFormer checkpoints (safetensors): configuration, weights, converted and back.

Of the configurations that their JSON allows, two families were published: V1-Base, and V1.1-Large
with Swin windows. Any other value of a field is refused by name.

All layers but one are copied under another name. The published material encoder reads a 13 x P x P
texture. Its input is always the same 13 numbers in every cell (x, y) with x + y <= P, and zero
elsewhere, and three of them, the tangent-space normal, are always (0.5, 0.5, 1). So its weights are
summed over those cells, and the normal's contribution is added to the bias: the same function at a
thousandth of the input and 10 million fewer weights (P = 32).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from model.config import NUM_TAPS, ModelConfig
from model.renderformer import RenderFormer
from model.weights import network_of, require_tensors
from storage.errors import TrilightError
from storage.records.material import PUBLISHED_COLUMNS

REGISTER_EPS = 1e-5
"""Epsilon of the published registers' mean position."""

WINDOW_BUNDLES = 8
"""Width of the published Swin windows."""

_FIXED: dict[str, Any] = {
    "dropout": 0.0,
    "activation": "swiglu",
    "norm_type": "rms_norm",
    "norm_first": True,
    "view_indep_qk_norm": True,
    "qk_norm": True,
    "bias": False,
    "pe_type": "rope",
    "rope_type": "triangle",
    "use_vn_encoder": True,
    "vn_encoder_norm_type": "rms_norm",
    "texture_channels": 13,
    "texture_encoder_norm_type": "rms_norm",
    "view_transformer_include_self_attn": True,
    "vdir_pe_type": "nerf",
    "vdir_num_freqs": 0,
    "include_alpha": False,
    "use_dpt_decoder": True,
    "turn_to_cam_coord": True,
    "use_ldr": False,
}
"""Fields with a single published value, which is also their default there."""

_DEFAULTS: dict[str, Any] = {
    "latent_dim": 768,
    "num_layers": 12,
    "num_heads": 6,
    "dim_feedforward": 3072,
    "num_register_tokens": 16,
    "rope_double_max_freq": False,
    "vertex_pe_num_freqs": 12,
    "vn_pe_num_freqs": 6,
    "texture_encode_patch_size": 32,
    "view_transformer_latent_dim": 768,
    "view_transformer_ffn_hidden_dim": 3072,
    "view_transformer_n_heads": 6,
    "view_transformer_n_layers": 6,
    "view_transformer_use_swin_attn": False,
    "patch_size": 8,
    "dpt_features": 128,
    "dpt_out_channels": [96, 192, 384, 768],
    "dpt_out_layers": None,
}
"""Other fields with their published defaults, which a configuration may omit."""

_EQUAL = (
    ("view_transformer_latent_dim", "latent_dim"),
    ("view_transformer_ffn_hidden_dim", "dim_feedforward"),
    ("view_transformer_n_heads", "num_heads"),
)
"""Pairs of fields of the two stages that are equal in both families, and always here."""


_SAME = {
    "latent_dim": "width",
    "num_layers": "encoder_layers",
    "num_heads": "num_heads",
    "dim_feedforward": "hidden_width",
    "num_register_tokens": "num_registers",
    "vn_pe_num_freqs": "normal_octaves",
    "view_transformer_n_layers": "decoder_layers",
    "patch_size": "patch_px",
    "dpt_features": "dpt_features",
}
"""Fields whose value is that of one field of ModelConfig."""


@dataclass(frozen=True, kw_only=True)
class PublishedConfig:
    """Content of a published configuration."""

    model: ModelConfig
    """Configuration of the network, in this project's terms."""
    texture_patch: int
    """Width P of its texture input in cells."""


def decode_published_config(fields: Mapping[str, Any]) -> PublishedConfig:
    """Return the content of a published config.json.

    Raises:
        TrilightError: a field is unknown or has an unpublished value; the message lists all.
    """
    _require_known(fields)
    got = _DEFAULTS | dict(fields)
    num_freqs = got["vertex_pe_num_freqs"] // 2
    layers = got["view_transformer_n_layers"]
    taps = got["dpt_out_layers"] or range(layers - NUM_TAPS, layers)
    model = ModelConfig(
        **{ours: got[theirs] for theirs, ours in _SAME.items()},
        rope_num_freqs=num_freqs,
        rope_max_freq=float(_max_freq(num_freqs, doubled=got["rope_double_max_freq"])),
        register_eps=REGISTER_EPS,
        window_bundles=WINDOW_BUNDLES if got["view_transformer_use_swin_attn"] else 0,
        head="dpt",
        dpt_channels=tuple(got["dpt_out_channels"]),
        dpt_taps=tuple(taps),
    )
    return PublishedConfig(model=model, texture_patch=got["texture_encode_patch_size"])


def encode_published_config(config: PublishedConfig) -> dict[str, Any]:
    """Return the config.json of a network, with all fields.

    Raises:
        TrilightError: the network is of neither family: a linear head, other material columns,
            windows of another width, or rotary frequencies that the published code cannot build.
    """
    model = config.model
    doubled = model.rope_max_freq == _max_freq(model.rope_num_freqs, doubled=True)
    if model.head != "dpt":
        _raise_unpublished("head linear", "dpt")
    if model.demodulated:
        _raise_unpublished("demodulated True", "False")
    if model.material_columns != PUBLISHED_COLUMNS:
        _raise_unpublished(f"material_columns {model.material_columns}", f"{PUBLISHED_COLUMNS}")
    if model.window_bundles not in (0, WINDOW_BUNDLES):
        _raise_unpublished(f"window_bundles {model.window_bundles}", f"0 or {WINDOW_BUNDLES}")
    if not doubled and model.rope_max_freq != _max_freq(model.rope_num_freqs, doubled=False):
        _raise_unpublished(
            f"rope_max_freq {model.rope_max_freq} of {model.rope_num_freqs} frequencies",
            "one less than their number, or than twice their number",
        )
    same = {theirs: getattr(model, ours) for theirs, ours in _SAME.items()}
    equal = {theirs: same[other] for theirs, other in _EQUAL}
    got = {
        **same,
        **equal,
        "rope_double_max_freq": doubled,
        "vertex_pe_num_freqs": 2 * model.rope_num_freqs,
        "texture_encode_patch_size": config.texture_patch,
        "view_transformer_use_swin_attn": bool(model.window_bundles),
        "dpt_out_channels": list(model.dpt_channels),
        "dpt_out_layers": list(model.dpt_taps),
    }
    return _FIXED | {name: got[name] for name in _DEFAULTS}


def _max_freq(num_freqs: int, *, doubled: bool) -> int:
    """Return the highest frequency as the published code derives it."""
    return 2 * num_freqs - 1 if doubled else num_freqs - 1


def _require_known(fields: Mapping[str, Any]) -> None:
    got = _FIXED | _DEFAULTS | dict(fields)
    wrong = [
        f"{name} (unknown)" for name in sorted(fields.keys() - _FIXED.keys() - _DEFAULTS.keys())
    ]
    wrong += [
        f"{name} {got[name]!r}, expected {expected!r}"
        for name, expected in _FIXED.items()
        if got[name] != expected
    ]
    wrong += [
        f"{name} {got[name]!r}, expected {other} {got[other]!r}"
        for name, other in _EQUAL
        if got[name] != got[other]
    ]
    wrong += [
        f"{name} {got[name]!r}, expected {type(default).__name__}"
        for name, default in _DEFAULTS.items()
        if default is not None and not isinstance(got[name], type(default))
    ]
    if wrong:
        raise TrilightError(
            f"published config: {'; '.join(wrong)}. Only the V1-Base and V1.1-Large families "
            "are read."
        )


def _raise_unpublished(got: str, expected: str) -> None:
    raise TrilightError(
        f"export: {got}; the published code builds {expected} only. Keep our own file, which "
        "`trilight` reads."
    )


FREQUENCY_TOLERANCE = 1e-6
"""Maximum relative difference of stored frequencies from the formula: float32's rounding."""


def load_published_weights(tensors: Mapping[str, Tensor], config: PublishedConfig) -> RenderFormer:
    """Return the network of published weights, float32, in evaluation mode on the CPU.

    Raises:
        TrilightError: names or shapes do not match the configuration (all are listed), or the
            rotary frequencies do not.
    """
    with torch.device("meta"):
        expected = export_published_weights(RenderFormer(config.model), config.texture_patch)
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


def export_published_weights(model: RenderFormer, texture_patch: int) -> dict[str, Tensor]:
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
