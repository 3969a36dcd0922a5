"""What follows a network's width: initial weights, and the rates of both optimisers."""

import dataclasses
import math

import pytest
import torch

from model.base_widths import BaseWidths
from model.config import SIZES, ModelConfig, hits_smoke, smoke
from model.renderformer import RenderFormer
from model.width_scales import WidthScale, scale_start, width_scales
from storage.errors import TrilightError
from tests.for_each import for_each

BASE = BaseWidths(width=128)


def made(config: ModelConfig) -> RenderFormer:
    with torch.device("meta"):
        return RenderFormer(config)


def wider(config: ModelConfig, times: int) -> ModelConfig:
    """Return a network with heads as wide as before."""
    return dataclasses.replace(
        config,
        width=times * config.width,
        num_heads=times * config.num_heads,
        hidden_width=times * config.hidden_width,
        pixel_width=times * config.pixel_width,
        filter_width=times * config.filter_width,
    )


@for_each("name", sorted(SIZES))
def test_without_a_base_width_nothing_follows_the_width(name: str) -> None:
    assert set(width_scales(made(SIZES[name]()), BaseWidths()).values()) == {WidthScale()}


@for_each("config", [smoke(), hits_smoke()])
def test_at_the_base_width_all_is_as_it_is(config: ModelConfig) -> None:
    assert set(width_scales(made(config), BASE).values()) == {WidthScale()}


def test_every_kind_of_weight_follows_its_own_rule() -> None:
    """By hand from Yang et al. 2021, table 3, four times as wide; Xavier's sqrt(2 / (n + m))."""
    scales = width_scales(made(wider(smoke(), 4)), BASE)
    hidden = WidthScale(start=1.0, adamw=1 / 4, muon=1 / 2)
    of_width = {
        "encoder.layers.0.attention.qkv.weight": hidden,
        "encoder.layers.1.ffn.down.weight": hidden,
        "decoder.layers.3.cross.k.weight": hidden,
        # only outputs grow, from 128 to 512; as Muon's steps have it already
        "encoder.tokens.material.weight": WidthScale(start=math.sqrt((10 + 512) / (10 + 128))),
        # only inputs grow; the 192 numbers of a bundle are wider than 128, and less than 512
        "decoder.head.last.weight": WidthScale(
            start=1 / 4 * math.sqrt((192 + 512) / (192 + 128)),
            adamw=1 / 4,
            muon=math.sqrt(1 / 4) * math.sqrt(192 / 512),
        ),
        "decoder.head.last.bias": WidthScale(),
        "encoder.registers_NW": WidthScale(),
        "decoder.token_W": WidthScale(),
        "decoder.layers.0.cross.q_norm.weight": WidthScale(),
        "decoder.layers.0.ffn_norm.weight": WidthScale(),
    }
    for name, expected in of_width.items():
        found = dataclasses.astuple(scales[name])
        assert found == pytest.approx(dataclasses.astuple(expected)), name


def test_heads_that_grow_ask_less_loudly() -> None:
    """1 / d in place of 1 / sqrt(d): a gain of the query's norm, initial and moved, by hand."""
    config = dataclasses.replace(wider(smoke(), 4), num_heads=2)
    gains = [s for n, s in width_scales(made(config), BASE).items() if n.endswith("q_norm.weight")]
    assert len(gains) == 2 + 2 * 4
    assert {round(gain.start, 12) for gain in gains} == {0.5}
    assert all(gain.adamw == gain.muon == gain.start for gain in gains)


def test_widths_of_pixels_and_filters_count_for_themselves() -> None:
    config = dataclasses.replace(hits_smoke(), pixel_width=256, filter_width=64)
    scales = width_scales(made(config), BASE)
    assert scales["decoder.head.second.weight"].adamw == 1 / 4
    # what pixels ask anchors by is asked by 1 / d as well
    assert scales["decoder.head.query.weight"].adamw == pytest.approx(1 / 4 * 1 / 2)
    assert scales["decoder.head.query.bias"].start == 1 / 2
    assert scales["decoder.filter.second.weight"].adamw == 1 / 2
    assert scales["decoder.layers.0.ffn.up.weight"] == WidthScale()


def test_weights_start_as_large_as_their_rule_says() -> None:
    model = RenderFormer(wider(smoke(), 2))
    model.initialise(torch.Generator().manual_seed(0))
    scale_start(model, width_scales(model, BASE))
    weights = dict(model.named_parameters())

    def spread(name: str) -> float:
        return float(weights[name].detach().std())

    # two dozen thousand numbers: their spread is known to half a percent
    assert spread("decoder.layers.0.ffn.up.weight") == pytest.approx(
        math.sqrt(2 / (256 + 768)), rel=0.02
    )
    # as at the base: of 192 numbers to 128
    assert spread("decoder.rays.weight") == pytest.approx(math.sqrt(2 / (192 + 128)), rel=0.02)
    assert spread("decoder.head.last.weight") == 0


@for_each("name", ["tiny", "small", "large", "hits-base"])
def test_every_size_has_a_network_at_the_base_width(name: str) -> None:
    config = SIZES[name]()
    at_base = BASE.of(config)
    assert (at_base.width, at_base.head_width) == (128, 64)
    assert at_base.head == config.head and at_base.dpt_taps == config.dpt_taps
    scales = width_scales(made(config), BASE)
    assert all(scale.start > 0 and scale.adamw <= 1 for scale in scales.values())


def test_heads_divide_the_base_width() -> None:
    with pytest.raises(TrilightError, match="width is 100 and head_width 64; expected an even"):
        BaseWidths(width=100)
