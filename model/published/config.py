"""Conversion between the published configuration and ours.

Of the configurations that its JSON allows, two families were published: V1-Base, and V1.1-Large
with Swin windows. Any other value of a field is refused by name.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from model.config import NUM_TAPS, ModelConfig
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


def decode_published(fields: Mapping[str, Any]) -> PublishedConfig:
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


def encode_published(config: PublishedConfig) -> dict[str, Any]:
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
