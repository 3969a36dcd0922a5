"""The formulas count what torch counts, and the named sizes are the sizes that they claim."""

import dataclasses

import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from model.config import SIZES, ModelConfig
from model.costs import Workload, costs, flops
from model.precision import set_precision
from model.renderformer import RenderFormer, count_parameters
from model.scene_tensors import batch_scenes
from tests.for_each import for_each
from tests.model.hits.test_decoder import hits_config
from tests.model.kit import FAMILIES, awake, random_scene, tiny_config

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
