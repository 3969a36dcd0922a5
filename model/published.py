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


PublishedConfig = tuple[ModelConfig, int]
"""Published configuration in our terms, and the width P of its texture input in cells."""


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
    return model, got["texture_encode_patch_size"]


def encode_published_config(config: PublishedConfig) -> dict[str, Any]:
    """Return the config.json of a network, with all fields.

    Raises:
        TrilightError: the network is of neither family: a linear head, other material columns,
            windows of another width, or rotary frequencies that the published code cannot build.
    """
    model, texture_patch = config
    doubled = model.rope_max_freq == _max_freq(model.rope_num_freqs, doubled=True)
    fixed = {"head": "dpt", "demodulated": False, "material_columns": PUBLISHED_COLUMNS}
    for name, expected in fixed.items():
        if getattr(model, name) != expected:
            _raise_unpublished(f"{name} {getattr(model, name)}", f"{expected}")
    if model.window_bundles not in (0, WINDOW_BUNDLES):
        _raise_unpublished(f"window_bundles {model.window_bundles}", f"0 or {WINDOW_BUNDLES}")
    if not doubled and model.rope_max_freq != _max_freq(model.rope_num_freqs, doubled=False):
        _raise_unpublished(
            f"rope_max_freq {model.rope_max_freq} of {model.rope_num_freqs} frequencies",
            "one less than their number, or than twice their number",
        )
    same = {theirs: getattr(model, ours) for theirs, ours in _SAME.items()}
    fields = {
        **same,
        **{theirs: same[other] for theirs, other in _EQUAL},
        "rope_double_max_freq": doubled,
        "vertex_pe_num_freqs": 2 * model.rope_num_freqs,
        "texture_encode_patch_size": texture_patch,
        "view_transformer_use_swin_attn": bool(model.window_bundles),
        "dpt_out_channels": list(model.dpt_channels),
        "dpt_out_layers": list(model.dpt_taps),
    }
    return _FIXED | {name: fields[name] for name in _DEFAULTS}


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
    model_config, texture_patch = config
    with torch.device("meta"):
        ours = RenderFormer(model_config)
        require_tensors(tensors, export_published_weights(ours, texture_patch))
    single = {name: tensor.float() for name, tensor in tensors.items()}
    folded = fold(single[f"{TEXTURE}.weight"], single[f"{TEXTURE}.bias"], texture_patch)
    state = dict(zip(MATERIAL, folded, strict=True))
    for name, like in ours.state_dict().items():
        if name not in MATERIAL:
            state[name] = single[_published_name(name)].reshape(like.shape)
    model = network_of(model_config, state)
    for name in FREQUENCIES:
        _require_frequencies(name, single[name], model.encoder.rotary.freqs_F)
    return model


def export_published_weights(model: RenderFormer, texture_patch: int) -> dict[str, Tensor]:
    """Return a network's tensors under published names, with the texture encoder unfolded.

    Reading them back gives exactly the same network.
    """
    state = model.state_dict()
    weight, bias = unfold(state.pop(MATERIAL[0]), state.pop(MATERIAL[1]), texture_patch)
    return {
        f"{TEXTURE}.weight": weight,
        f"{TEXTURE}.bias": bias,
        **{name: model.encoder.rotary.freqs_F.clone() for name in FREQUENCIES},
        **{
            _published_name(name): tensor.reshape(*[1] * _LEADING.get(name, 0), *tensor.shape)
            for name, tensor in state.items()
        },
    }


def _require_frequencies(name: str, got_F: Tensor, expected_F: Tensor) -> None:
    if not torch.allclose(got_F, expected_F, rtol=FREQUENCY_TOLERANCE, atol=0):
        raise TrilightError(
            f"published weights: {name} is {got_F.tolist()}, but the configuration means "
            f"{expected_F.tolist()}; expected a config.json that belongs to these weights."
        )


TEXTURE = "texture_encoder"
"""Published name of the layer that is folded and not copied (`fold`)."""

MATERIAL = ("encoder.tokens.material.weight", "encoder.tokens.material.bias")
"""Our names of that layer's weights."""

FREQUENCIES = ("transformer.rope_emb.freqs", "view_transformer.transformer.rope_emb.freqs")
"""Published names of the rotary frequencies of both stages, which our configuration determines."""

_LEADING = {"encoder.tokens.token_W": 2, "encoder.registers_NW": 1, "decoder.token_W": 2}
"""Number of leading dimensions of size 1 that the published learned vectors have."""

_DPT = "view_transformer.out_dpt"

_NAMES = (
    ("encoder.tokens.token_W", "tri_token"),
    ("encoder.registers_NW", "reg_tokens"),
    ("decoder.token_W", "view_transformer.ray_map_patch_token"),
    ("encoder.tokens.material_norm", f"{TEXTURE}_norm"),
    ("encoder.tokens.normal_norm", "vn_encoder_norm"),
    ("encoder.tokens.normal", "vn_encoding_proj"),
    ("decoder.rays", "view_transformer.ray_map_encoder"),
    ("encoder.layers", "transformer.layers"),
    ("decoder.layers", "view_transformer.transformer.layers"),
    (".attention_norm.", ".query_norm."), (".attention.", ".multihead_attn."),
    (".self_norm.", ".self_attn_norm."), (".self_attention.", ".self_attn."),
    (".cross_norm.", ".query_norm."), (".cross.context_norm.", ".kv_norm."),
    (".cross.", ".multihead_attn."),
    (".qkv.", ".in_proj."), (".out.", ".out_proj."),
    (".q.", ".q_proj."), (".k.", ".k_proj."), (".v.", ".v_proj."),
    (".gate.", ".w1."), (".up.", ".w3."), (".down.", ".w2."),
    ("decoder.head.project", f"{_DPT}.projects"),
    ("decoder.head.resize", f"{_DPT}.resize_layers"),
    ("decoder.head.halve", f"{_DPT}.scratch.output_conv1"),
    ("decoder.head.widen", f"{_DPT}.scratch.output_conv2.0"),
    ("decoder.head.last", f"{_DPT}.scratch.output_conv2.2"),
    *((f"decoder.head.reassemble.{level}", f"{_DPT}.scratch.layer{level + 1}_rn")
      for level in range(NUM_TAPS)),
    *((f"decoder.head.fuse.{level}", f"{_DPT}.scratch.refinenet{level + 1}")
      for level in range(NUM_TAPS)),
    (".project.", ".out_conv."), (".skip.", ".resConvUnit1."), (".refine.", ".resConvUnit2."),
    (".first.", ".conv1."), (".second.", ".conv2."),
)  # fmt: skip
"""Parts of our names of weights, with those that replace them in published names, in order."""


def _published_name(name: str) -> str:
    """Return the published name of a weight other than MATERIAL."""
    for ours, theirs in _NAMES:
        name = name.replace(ours, theirs)
    return name


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
