"""Configurations: sizes, what they cost, and what follows a network's width."""

import dataclasses
import math

import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from model.base_widths import BaseWidths
from model.config import SIZES, ModelConfig, base, hits_smoke, smoke
from model.costs import Workload, costs, flops
from model.precision import set_precision
from model.renderformer import RenderFormer, count_parameters
from model.scene_tensors import batch_scenes
from model.width_scales import WidthScale, scale_start, width_scales
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.model.hits.test_decoder import hits_config
from tests.model.kit import FAMILIES, awake, random_scene, tiny_config


def test_base_has_the_published_parameters_but_for_the_texture_encoder() -> None:
    """Its first layer reads 13 x 32 x 32 equal numbers per triangle, and ours reads ten."""
    with torch.device("meta"):
        got = count_parameters(RenderFormer(base()))
    # the published count is known to 5,000; the six frozen frequencies are not counted here
    assert abs(got - (205_170_000 - 768 * (13 * 32 * 32 - 10))) < 5_000


@for_each(
    ("head", "changes", "message"),
    [
        ("linear", {"width": 50}, "heads of equal width"),
        ("linear", {"rope_num_freqs": 2}, "rope_num_freqs 2; expected at most 1"),
        ("linear", {"rope_num_freqs": 0}, "from 1"),
        ("linear", {"rope_max_freq": 0.5}, "from 1"),
        ("linear", {"dpt_features": 4}, "dpt fields beside a linear head"),
        ("linear", {"demodulated": True}, "hit_rays 0 with view_stage bundles; expected 1 or"),
        ("linear", {"hit_rays": 1}, "hit_rays 1 with view_stage bundles; expected 0, or demodu"),
        ("linear", {"head": "mlp"}, "head is 'mlp'; expected dpt or linear"),
        ("linear", {"head": "dpt", "dpt_features": 4}, "four of each"),
        ("dpt", {"dpt_taps": (0, 1, 2, 3)}, "dpt_taps .* expected layers below 2"),
        ("dpt", {"dpt_features": 3}, "dpt_features 3; expected an even number"),
        ("dpt", {"patch_px": 4}, "patch_px 4 with a dpt head"),
    ],
)
def test_a_contradictory_config_is_refused(
    head: str, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(TrilightError, match=message):
        ModelConfig(**vars(tiny_config(head)) | changes)


REPAIRED = tiny_config(patch_px=4, demodulated=True, hit_rays=1)


@for_each(
    "config",
    [
        *map(tiny_config, FAMILIES),
        REPAIRED,
        dataclasses.replace(REPAIRED, window_bundles=2),
        tiny_config("dpt", demodulated=True, hit_rays=1),
    ],
)
@for_each(("triangles", "views", "resolution"), [(5, 1, 16), (9, 3, 48)])
def test_flops_are_those_that_torch_counts(
    config: ModelConfig, triangles: int, views: int, resolution: int
) -> None:
    batch = batch_scenes([random_scene(triangles, views, dtype=torch.float32)])
    model = awake(config, torch.float32)
    # the math kernel, whose two products torch counts; it has no count for a CPU's fused one
    with FlopCounterMode(display=False) as counter, sdpa_kernel(SDPBackend.MATH), torch.no_grad():
        model(batch, resolution)
    workload = Workload(triangles=triangles, views=views, resolution=resolution)
    assert sum(flops(config, workload).values()) == counter.get_total_flops()


def test_the_published_base_costs_what_was_counted_elsewhere() -> None:
    """1536 triangles at 256 pixels: 726 GFLOP, 31.4 of them for the texture, 52.8 for the head."""
    counted = flops(SIZES["base"](), Workload(triangles=1536, views=1, resolution=256))
    stages = sum(counted.values()) - counted["head"]
    # printed to a GFLOP; the tokens, a third of one, were not counted
    assert stages == pytest.approx((726 - 31.4 - 52.8) * 1e9, abs=1e9)
    assert counted["head"] < 52.8e9, "its 1x1 comes before the upsampling here"


@for_each(("name", "millions"), [("tiny", 5.2), ("small", 71), ("base", 195), ("large", 483)])
def test_sizes_have_the_parameters_that_they_claim(name: str, millions: float) -> None:
    workload = Workload(triangles=10, views=1, resolution=64)
    got = costs(SIZES[name](), workload)
    with torch.device("meta"):
        assert sum(got.parameters.values()) == count_parameters(RenderFormer(SIZES[name]()))
    # to the digits claimed
    assert sum(got.parameters.values()) / 1e6 == pytest.approx(millions, abs=0.5)
    assert got.training_bytes == 16 * sum(got.parameters.values())


def test_an_encoder_that_is_not_there_has_no_parameters() -> None:
    config = hits_config(scene_tokens=False)
    got = costs(config, Workload(triangles=7, views=1, resolution=16))
    assert sum(got.parameters.values()) == count_parameters(RenderFormer(config))


def test_bytes_are_those_of_the_tensors() -> None:
    config = tiny_config("dpt")
    got = costs(config, Workload(triangles=7, views=1, resolution=16))
    batch = batch_scenes([random_scene(7, 1, dtype=torch.float32)])
    for name in ("float32", "bfloat16"):
        model = set_precision(awake(config, torch.float32), name)
        assert sum(weight.nbytes for weight in model.parameters()) == got.weight_bytes[name]
        with torch.no_grad():
            encoded = model.encode(batch)
        assert sum(k.nbytes + v.nbytes for k, v in encoded.keys_values) == got.scene_bytes[name]


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
    model.initialize(torch.Generator().manual_seed(0))
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
