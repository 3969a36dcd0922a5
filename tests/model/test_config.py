"""Configurations: sizes, what they cost, what follows a network's width, precision and packing.

What is rounded, recomputed or packed gives what it gave, as near as is said.
"""

import copy
import dataclasses
import itertools
import math
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from model import positions, precision
from model.config import SIZES, BaseWidths, ModelConfig
from model.costs import Workload, costs, flops
from model.precision import rounded_parts, set_precision, tf32
from model.renderformer import RenderFormer, count_parameters
from model.scene_tensors import SceneBatch, batch_scenes, map_tensors, scene_tensors
from model.width_scales import WidthScale, scale_start, width_scales
from storage.errors import TrilightError
from storage.records.material import EMISSION, material_width
from storage.records.scene import ARRAY_FIELDS
from storage.records.texture import Environment
from tests.for_each import for_each
from tests.model.kit import (
    FAMILIES,
    RESOLUTION,
    awake,
    hits_config,
    picture_and_gradients,
    random_scene,
    render,
    tensors_of,
    tiny_config,
)
from tests.train.toy import toy_scene

LINEAR, DPT, HITS = tiny_config(), tiny_config("dpt"), hits_config()
BASE = BaseWidths(width=128)


@for_each(
    ("config", "changes", "message"),
    [
        (LINEAR, {"width": 50}, "heads of equal width"),
        (LINEAR, {"rope_num_freqs": 2}, "rope_num_freqs 2; expected at most 1"),
        (LINEAR, {"rope_num_freqs": 0}, "from 1"),
        (LINEAR, {"rope_max_freq": 0.5}, "from 1"),
        (LINEAR, {"dpt_features": 4}, "dpt fields beside a linear head"),
        (LINEAR, {"demodulated": True}, "hit_rays 0 with view_stage bundles; expected 1 or"),
        (LINEAR, {"hit_rays": 1}, "hit_rays 1 with view_stage bundles; expected 0, or demodu"),
        (LINEAR, {"head": "mlp"}, "head is 'mlp'; expected dpt or linear"),
        (LINEAR, {"head": "dpt", "dpt_features": 4}, "four of each"),
        (DPT, {"dpt_taps": (0, 1, 2, 3)}, "dpt_taps .* expected layers below 2"),
        (DPT, {"dpt_features": 3}, "dpt_features 3; expected an even number"),
        (DPT, {"patch_px": 4}, "patch_px 4 with a dpt head"),
        (HITS, {"hit_rays": 0}, "hit_rays 0 with view_stage hits"),
        (HITS, {"pixel_width": 0}, "pixel_width 0"),
        (HITS, {"hit_anchors": 12}, "a multiple of 8"),
        (HITS, {"patch_px": 4}, "patch_px 4"),
        (HITS, {"view_stage": "bundles"}, "hit_anchors 8 with view_stage bundles; expected 0"),
        (BASE, {"width": 100}, "width is 100 and head_width 64; expected an even"),
    ],
)
def test_a_contradictory_config_is_refused(
    config: ModelConfig | BaseWidths, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(TrilightError, match=message):
        dataclasses.replace(config, **changes)


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
    """1536 triangles at 256 pixels: 726 GFLOP, 31.4 of them for the texture, 52.8 for the head.

    And its parameters, but for the texture encoder, whose first layer reads 13 x 32 x 32 equal
    numbers per triangle, and ours reads ten.
    """
    # the published count is known to 5,000; the six frozen frequencies are not counted here
    parameters = count_parameters(made(SIZES["base"]()))
    assert abs(parameters - (205_170_000 - 768 * (13 * 32 * 32 - 10))) < 5_000
    counted = flops(SIZES["base"](), Workload(triangles=1536, views=1, resolution=256))
    stages = sum(counted.values()) - counted["head"]
    # printed to a GFLOP; the tokens, a third of one, were not counted
    assert stages == pytest.approx((726 - 31.4 - 52.8) * 1e9, abs=1e9)
    assert counted["head"] < 52.8e9, "its 1x1 comes before the upsampling here"


@for_each(("name", "millions"), [("tiny", 5.2), ("small", 71), ("base", 195), ("large", 483)])
def test_sizes_have_the_parameters_that_they_claim(name: str, millions: float) -> None:
    workload = Workload(triangles=10, views=1, resolution=64)
    got = costs(SIZES[name](), workload)
    assert sum(got.parameters.values()) == count_parameters(made(SIZES[name]()))
    # to the digits claimed
    assert sum(got.parameters.values()) / 1e6 == pytest.approx(millions, abs=0.5)
    assert got.training_bytes == 16 * sum(got.parameters.values())


def test_an_encoder_that_is_not_there_has_no_parameters() -> None:
    config = hits_config(scene_tokens=False)
    got = costs(config, Workload(triangles=7, views=1, resolution=16))
    assert sum(got.parameters.values()) == count_parameters(made(config))


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


def test_without_a_base_width_or_at_it_nothing_follows_the_width() -> None:
    configs = [(SIZES[name](), BaseWidths()) for name in SIZES]
    for config, base_widths in (*configs, (SIZES["smoke"](), BASE), (SIZES["hits-smoke"](), BASE)):
        assert set(width_scales(made(config), base_widths).values()) == {WidthScale()}


def test_every_kind_of_weight_follows_its_own_rule() -> None:
    """By hand from Yang et al. 2021, table 3, four times as wide; Xavier's sqrt(2 / (n + m))."""
    scales = width_scales(made(wider(SIZES["smoke"](), 4)), BASE)
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
    config = dataclasses.replace(wider(SIZES["smoke"](), 4), num_heads=2)
    gains = [s for n, s in width_scales(made(config), BASE).items() if n.endswith("q_norm.weight")]
    assert len(gains) == 2 + 2 * 4
    assert {round(gain.start, 12) for gain in gains} == {0.5}
    assert all(gain.adamw == gain.muon == gain.start for gain in gains)


def test_widths_of_pixels_and_filters_count_for_themselves() -> None:
    config = dataclasses.replace(SIZES["hits-smoke"](), pixel_width=256, filter_width=64)
    scales = width_scales(made(config), BASE)
    assert scales["decoder.head.second.weight"].adamw == 1 / 4
    # what pixels ask anchors by is asked by 1 / d as well
    assert scales["decoder.head.query.weight"].adamw == pytest.approx(1 / 4 * 1 / 2)
    assert scales["decoder.head.query.bias"].start == 1 / 2
    assert scales["decoder.filter.second.weight"].adamw == 1 / 2
    assert scales["decoder.layers.0.ffn.up.weight"] == WidthScale()


def test_weights_start_as_large_as_their_rule_says() -> None:
    model = RenderFormer(wider(SIZES["smoke"](), 2))
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


def batch_of(*lengths: int, dtype: torch.dtype = torch.float64) -> SceneBatch:
    """Return a batch of scenes of so many triangles, each a scene of its own."""
    return batch_scenes([random_scene(n, seed=row, dtype=dtype) for row, n in enumerate(lengths)])


@for_each("family", FAMILIES)
def test_bfloat16_rounds_the_layers_and_pictures_are_float32_and_near(family: str) -> None:
    """It keeps what makes tokens."""
    model = awake(tiny_config(family), torch.float32)
    scene = random_scene(9, dtype=torch.float32)
    expected = render(model, scene)
    assert torch.equal(render(set_precision(model, "float32"), scene), expected)
    got = render(set_precision(model, "bfloat16"), scene)
    assert got.dtype == torch.float32
    # 8 bits through some ten layers; pictures of size 1, and not equal at all
    error = (got - expected).square().mean().sqrt() / expected.std()
    assert 1e-5 < error < 5e-2
    rounded = {id(weight) for part in rounded_parts(model) for weight in part.parameters()}
    for name, weight in model.named_parameters():
        assert weight.dtype == (torch.bfloat16 if id(weight) in rounded else torch.float32), name
    exact = {name for name, weight in model.named_parameters() if id(weight) not in rounded}
    tokens = {"encoder.tokens.material.weight", "decoder.rays.weight", "encoder.registers_NW"}
    assert exact > tokens | {"decoder.head.last.weight"}
    assert "decoder.layers.0.ffn.up.weight" not in exact
    assert model.encoder.rotary.freqs_F.dtype == torch.float32


def test_positions_are_never_rounded() -> None:
    """A scene 100 m out: bfloat16 would know its positions to half a metre."""
    model = set_precision(awake(tiny_config(), torch.float32), "bfloat16")
    near = random_scene(6)
    far = copy.deepcopy(near)
    far.triangles_T33.add_(100.0)
    far.c2w_V44[:, :3, 3].add_(100.0)
    pictures = [render(model, map_tensors(scene, torch.Tensor.float)) for scene in (near, far)]
    # the angles move by 100 x 5 / 2^24; what they turn is rounded to 8 bits, so some ulps of that
    assert (pictures[0] - pictures[1]).abs().max() < 0.1 * pictures[0].std()


@for_each(
    ("name", "message"),
    [
        ("tf32", "precision tf32: the network is on cpu"),
        ("float16", "precision float16: the network is on cpu"),
        ("float8", "float8.*expected one of float32, bfloat16"),
    ],
)
def test_what_a_cpu_has_no_path_for_is_refused(name: str, message: str) -> None:
    with pytest.raises(TrilightError, match=message):
        set_precision(awake(tiny_config(), torch.float32), name)


def test_tf32_is_set_for_a_while_only() -> None:
    before = torch.backends.cuda.matmul.fp32_precision
    for allowed, expected in ((True, "tf32"), (False, "ieee")):
        with tf32(allowed):
            assert torch.backends.cuda.matmul.fp32_precision == expected
        assert torch.backends.cuda.matmul.fp32_precision == before


@for_each("family", FAMILIES)
def test_recomputed_gradients_are_the_same_bit_by_bit(family: str) -> None:
    model, batch = awake(tiny_config(family)), batch_of(3, 5)
    model.recompute_activations(False)
    kept = picture_and_gradients(model, batch)
    model.recompute_activations(True)
    again = picture_and_gradients(model, batch)
    assert kept.keys() == again.keys() == {"picture", *dict(model.named_parameters())}
    for name, value in kept.items():
        assert torch.equal(value, again[name]), name


def test_less_is_kept_for_the_way_back() -> None:
    model, batch, kept = awake(tiny_config()), batch_of(40), [0, 0]
    for wanted in (False, True):
        model.recompute_activations(wanted)

        def keep(tensor: Tensor, wanted: bool = wanted) -> Tensor:
            kept[wanted] += tensor.numel()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            model(batch, RESOLUTION)
    assert kept[1] < 0.5 * kept[0]


@for_each("recompute", [False, True])
@for_each("family", ["linear", "dpt"])
def test_rounding_together_changes_no_bit(
    family: str, recompute: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = awake(tiny_config(family), dtype=torch.float32)
    model.recompute_activations(recompute)
    batch = batch_of(3, 5, dtype=torch.float32)
    rounded = mock.Mock(wraps=precision._copy_as)

    @torch.autocast("cpu", torch.bfloat16)
    def results() -> dict[str, Tensor]:
        return picture_and_gradients(model, batch)

    monkeypatch.setattr(precision, "_copy_as", rounded)
    found = results()
    layers = len(model.encoder.layers) + len(model.decoder.layers) + (family == "dpt")
    assert rounded.call_count == 2 * layers, "once forth and once back for each layer, and the head"
    for module in ("layers", "view_decoder"):
        monkeypatch.setattr(f"model.{module}.rounded_weights", lambda *_: {})
    alone = results()
    assert found.keys() == alone.keys()
    for name, value in found.items():
        assert torch.equal(value, alone[name]), name


def test_every_triangle_carries_its_own_and_shares_no_memory_with_the_scene() -> None:
    scene = toy_scene(0)
    before = {name: getattr(scene, name).copy() for name in ARRAY_FIELDS}
    tensors = scene_tensors(scene)
    assert tensors.num_triangles == scene.num_triangles
    assert tensors.num_views == scene.num_views
    for row in range(scene.num_triangles):
        corners = scene.faces[row]
        material = scene.materials[scene.material_index[row]]
        np.testing.assert_array_equal(tensors.triangles_T33[row], scene.vertex_positions[corners])
        np.testing.assert_array_equal(tensors.normals_T33[row], scene.vertex_normals[corners])
        np.testing.assert_array_equal(tensors.material_TM[row, :7], material[:7])
        emission = 10.0 ** tensors.material_TM[row, 7:].double().numpy() - 1
        # emission of 20 through a float32 logarithm
        np.testing.assert_allclose(emission, material[EMISSION], atol=1e-4)
    assert tensors.material_TM.shape[1] == material_width()
    for value in tensors_of(tensors).values():
        assert value.dtype == torch.float32
        value.fill_(-1)
    for name, array in before.items():
        np.testing.assert_array_equal(getattr(scene, name), array, err_msg=name)


def test_batches_are_padded_with_zeros_to_the_longest_and_no_further() -> None:
    scenes = [random_scene(3, seed=1), random_scene(7, seed=2), random_scene(5, seed=3)]
    batch = batch_scenes(scenes)
    assert batch.num_triangles == (3, 7, 5)
    assert batch.triangles_BT33.shape[1] == 7
    assert batch.is_triangle_BT is not None
    assert batch.is_triangle_BT.sum(1).tolist() == [3, 7, 5]
    for row, scene in enumerate(scenes):
        length = scene.num_triangles
        for name in ("triangles", "normals", "material"):
            suffix = "M" if name == "material" else "33"
            padded = getattr(batch, f"{name}_BT{suffix}")[row]
            assert torch.equal(padded[:length], getattr(scene, f"{name}_T{suffix}"))
            assert torch.all(padded[length:] == 0)
    equal = batch_of(4, 4)
    assert equal.is_triangle_BT is None and equal.num_triangles is None, "no mask is needed"
    for height, radiance, is_there in ((2, 1.0, True), (2, 0.0, False), (1, 0.0, False)):
        texels = np.full((height, 2 * height, 3), radiance, np.float32)
        below = dataclasses.replace(toy_scene(0), environment=Environment(radiance_rgb=texels))
        batch = batch_scenes([scene_tensors(below)])
        assert (batch.skies is not None) == is_there, "a black sky is none"


@for_each("family", FAMILIES)
def test_a_packed_batch_is_the_padded_one(family: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a card the kernel is torch's; here its slow twin, sequence after sequence, no mask."""
    model, batch = awake(tiny_config(family)), batch_of(5, 9, 1)
    padded = picture_and_gradients(model, batch)
    monkeypatch.setattr(positions, "supports_packed", lambda *_: True)
    monkeypatch.setattr("torch.nn.attention.varlen.varlen_attn", _attend_each)
    monkeypatch.setattr("model.attention.scaled_dot_product_attention", _forbid_masks)
    for name, found in picture_and_gradients(model, batch).items():
        wanted = padded[name]
        assert (found - wanted).abs().max() <= 1e-11 * wanted.abs().max().clamp(min=1), name


def _attend_each(
    q: Tensor, k: Tensor, v: Tensor, q_starts: Tensor, k_starts: Tensor, *_: int
) -> Tensor:
    parts = []
    spans = zip(*(itertools.pairwise(each.tolist()) for each in (q_starts, k_starts)), strict=True)
    for (first, end), (low, high) in spans:
        rows = (x.transpose(0, 1)[None] for x in (q[first:end], k[low:high], v[low:high]))
        parts.append(_forbid_masks(*rows)[0].transpose(0, 1))
    return torch.cat(parts)


def _forbid_masks(q: Tensor, k: Tensor, v: Tensor, attn_mask: Tensor | None = None) -> Tensor:
    assert attn_mask is None, "nothing that is padded is attended with a mask"
    return torch.nn.functional.scaled_dot_product_attention(q, k, v)
