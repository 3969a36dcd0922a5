"""Published checkpoints go in and out without loss, and nothing else goes in."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from model.config import SIZES, ModelConfig
from model.published.config import PublishedConfig, decode_published, encode_published
from model.published.convert import (
    NORMAL,
    TANGENT_NORMAL,
    TEXTURE_CHANNELS,
    _require_frequencies,
    fold,
    load_published,
    to_published,
    unfold,
)
from model.weights import read_tensors
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.model.kit import awake, tiny_config

SWIN_LARGE: dict[str, Any] = {
    "latent_dim": 1024, "num_layers": 12, "num_heads": 8, "dim_feedforward": 4096,
    "num_register_tokens": 32, "rope_double_max_freq": True, "texture_encode_patch_size": 1,
    "view_transformer_latent_dim": 1024, "view_transformer_ffn_hidden_dim": 4096,
    "view_transformer_n_heads": 8, "view_transformer_n_layers": 12,
    "view_transformer_use_swin_attn": True, "dpt_features": 256,
    "dpt_out_channels": [256, 512, 1024, 1024], "dpt_out_layers": [2, 5, 8, 11],
}  # fmt: skip
"""V1.1-Large as described; what is left out has V1-Base's value."""

FREQS = "view_transformer.transformer.rope_emb.freqs"


def publishable(family: str) -> ModelConfig:
    """Return a tiny configuration of a published family."""
    wide = {"width": 144, "num_heads": 2, "rope_num_freqs": 3}
    if family == "dpt":
        return tiny_config("dpt", **wide, rope_max_freq=2.0, register_eps=1e-5)
    return tiny_config("swin", **wide, rope_max_freq=5.0, window_bundles=8, register_eps=1e-5)


def test_the_published_sizes_are_the_named_ones() -> None:
    for fields, name, patch in (({}, "base", 32), (SWIN_LARGE, "large", 1)):
        got = decode_published(fields)
        assert dataclasses.replace(got.model, register_eps=0.0) == SIZES[name]()
        assert got.model.register_eps == 1e-5
        assert got.texture_patch == patch


@for_each("family", ["dpt", "swin"])
@for_each("patch", [1, 8])
def test_export_and_import_give_the_same_network(family: str, patch: int) -> None:
    config = PublishedConfig(model=publishable(family), texture_patch=patch)
    assert decode_published(json.loads(json.dumps(encode_published(config)))) == config
    model = awake(config.model, torch.float32)
    again = load_published(to_published(model, patch), config)
    assert again.state_dict().keys() == model.state_dict().keys()
    for name, tensor in again.state_dict().items():
        assert torch.equal(tensor, model.state_dict()[name]), name


@for_each("name", ["base_tiny", "swin_tiny"])
def test_export_gives_back_what_was_published(shared: Path, name: str) -> None:
    """All but the texture encoder bit by bit; that one as a function, by the test above."""
    path = shared / "renderformer_reference" / f"{name}.safetensors"
    if not path.exists():
        pytest.skip(f"{path} is missing")
    _, metadata = read_tensors(path)
    config = decode_published(json.loads(metadata["config"]))
    published = {
        key.removeprefix("param."): tensor.float()
        for key, tensor in load_file(path).items()
        if key.startswith("param.")
    }
    exported = to_published(load_published(published, config), config.texture_patch)
    assert exported.keys() == published.keys()
    for key, tensor in exported.items():
        assert tensor.shape == published[key].shape, key
        if not key.startswith("texture_encoder."):
            assert torch.equal(tensor, published[key]), key


def test_frequencies_differ_by_their_rounding_alone() -> None:
    """Others are those of another configuration, with which the same weights mean other places."""
    formula = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)
    _require_frequencies("freqs", formula * (1 + 0.9e-6), formula)
    for wrong in (1 - 1.5e-6, 1 + 1.5e-6):
        with pytest.raises(TrilightError, match="freqs is .*expected a config.json that belongs"):
            _require_frequencies("freqs", formula * wrong, formula)


@for_each(
    ("fields", "message"),
    [
        ({"activation": "gelu"}, "activation 'gelu', expected 'swiglu'"),
        ({"use_dpt_decoder": False}, "use_dpt_decoder False, expected True"),
        ({"num_frequencies": 3}, r"num_frequencies \(unknown\)"),
        ({"latent_dim": 1536}, "view_transformer_latent_dim 768, expected latent_dim 1536"),
        ({"dpt_out_channels": 3}, "dpt_out_channels 3, expected list"),
        ({"dpt_out_layers": [0, 1, 2, 99]}, "dpt_taps"),
    ],
)
def test_what_was_never_published_is_refused_by_name(fields: dict, message: str) -> None:
    with pytest.raises(TrilightError, match=message):
        decode_published(fields)


@for_each(
    ("changes", "message"),
    [
        ({"head": "linear", "dpt_features": 0, "dpt_channels": (), "dpt_taps": ()}, "head linear"),
        ({"window_bundles": 4}, "window_bundles 4"),
        ({"rope_max_freq": 3.0}, "rope_max_freq 3.0 of 3 frequencies"),
        ({"demodulated": True, "hit_rays": 1}, "demodulated True"),
    ],
)
def test_what_their_code_cannot_build_is_not_exported(changes: dict, message: str) -> None:
    model = dataclasses.replace(publishable("dpt"), **changes)
    with pytest.raises(TrilightError, match=message):
        encode_published(PublishedConfig(model=model, texture_patch=1))


@for_each(
    ("name", "tensor", "message"),
    [
        ("vn_encoding_proj.bias", None, r"vn_encoding_proj.bias is missing, expected \(144,\)"),
        ("reg_tokens", torch.zeros(1, 3, 144), r"is \(1, 3, 144\), expected \(1, 2, 144\)"),
        ("stranger.weight", torch.zeros(2), r"stranger.weight is \(2,\), expected no such tensor"),
        ("texture_encoder.weight", torch.zeros(144, 208), r"is \(144, 208\), expected \(144, 13\)"),
        (FREQS, torch.tensor([1.01, 2**0.5, 2.0]), f"{FREQS} is .* the configuration means"),
    ],
)
def test_wrong_tensors_are_listed(name: str, tensor: Tensor | None, message: str) -> None:
    config = PublishedConfig(model=publishable("dpt"), texture_patch=1)
    tensors = to_published(awake(config.model, torch.float32), 1)
    tensors.pop(name, None)
    if tensor is not None:
        tensors[name] = tensor
    with pytest.raises(TrilightError, match=message):
        load_published(tensors, config)


WIDTH = 5


def published_layer(patch: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(patch)
    inputs = TEXTURE_CHANNELS * patch**2
    weight = torch.randn(WIDTH, inputs, generator=generator, dtype=torch.float64)
    return weight, torch.randn(WIDTH, generator=generator, dtype=torch.float64)


def texture(material_TM: Tensor, patch: int) -> Tensor:
    """Return the published input [T, 13 P P], cell by cell."""
    pictures = torch.zeros(len(material_TM), TEXTURE_CHANNELS, patch, patch, dtype=torch.float64)
    normal = torch.tensor(TANGENT_NORMAL, dtype=torch.float64).expand(len(material_TM), 3)
    thirteen = torch.cat([material_TM[:, :7], normal, material_TM[:, 7:]], dim=1)
    for x in range(patch):
        for y in range(patch):
            if x + y <= patch:
                pictures[:, :, x, y] = thirteen
    return pictures.flatten(1)


@for_each(("patch", "cells"), [(1, 1), (8, 43), (32, 559)])
def test_a_folded_layer_is_the_unfolded_one(patch: int, cells: int) -> None:
    weight, bias = published_layer(patch)
    material = torch.rand(4, 10, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    pictures = texture(material, patch)
    assert int((pictures[0, : patch**2] != 0).sum()) == cells
    ten, folded_bias = fold(weight, bias, patch)
    # float64 sums of 559 x 13 products of size 1
    expected = pictures @ weight.T + bias
    torch.testing.assert_close(material @ ten.T + folded_bias, expected, rtol=0, atol=1e-11)


@for_each("patch", [1, 8, 32])
def test_folding_undoes_unfolding_bit_by_bit(patch: int) -> None:
    ten = torch.randn(WIDTH, 10, generator=torch.Generator().manual_seed(1))
    bias = torch.randn(WIDTH, generator=torch.Generator().manual_seed(2))
    weight, same_bias = unfold(ten, bias, patch)
    assert weight.shape == (WIDTH, TEXTURE_CHANNELS * patch**2)
    again, again_bias = fold(weight, same_bias, patch)
    assert torch.equal(again, ten) and torch.equal(again_bias, bias)


def test_folding_sums_in_float64() -> None:
    """559 float32 weights that cancel: a float32 sum would keep their rounding."""
    weight = torch.full((1, TEXTURE_CHANNELS * 32**2), 0.1)
    ten, bias = fold(weight, torch.zeros(1), 32)
    exact = 559 * float(torch.tensor(0.1))
    assert ten[0, 0].item() == torch.tensor(exact).item()
    normal_sum = exact * sum(TANGENT_NORMAL)
    assert bias.item() == torch.tensor(normal_sum).item()
    assert NORMAL == slice(7, 10)
