"""Tensors under published names -> a network of ours, and back."""

from collections.abc import Mapping

import torch
from torch import Tensor

from model.published.config import PublishedConfig
from model.published.names import (
    BUNDLE_TOKEN,
    FREQUENCIES,
    REGISTERS,
    TEXTURE,
    TRIANGLE_TOKEN,
    module_names,
)
from model.published.texture import fold, unfold
from model.renderformer import RenderFormer
from model.weights import network_of, require_tensors
from storage.errors import TrilightError

FREQUENCY_TOLERANCE = 1e-6
"""Largest relative difference of the stored frequencies from the formula's: float32's rounding."""


def from_published(tensors: Mapping[str, Tensor], config: PublishedConfig) -> RenderFormer:
    """Return the network of published tensors, float32, in evaluation mode on the CPU.

    Raises:
        TrilightError: names or shapes are not those of the configuration, each listed; or the
            rotary frequencies are not those that the configuration means.
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
    """Return a network's tensors under published names; the texture encoder is unfolded.

    Reading them back gives the same network, bit by bit.
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
