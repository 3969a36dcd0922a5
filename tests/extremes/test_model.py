"""The network at the ends of what it may be given, and in few bits."""

import dataclasses
import functools
import math
import warnings

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from model.attention import attend
from model.config import SIZES
from model.layers import LAYER_NORM_EPS, Norm
from model.open import BUILTIN_TOKENS, open_network
from model.positions import TriangleRotary
from model.scene_tensors import MAX_NETWORK_M, SceneBatch, batch_scenes, scene_tensors
from storage.conventions import HALF_FLOAT_MAX
from storage.errors import TrilightError
from tests.model.kit import FAMILIES, attend_reference, awake, random_scene, tiny_config
from tests.train.toy import toy_scene

EMISSIONS = [0.0, 1e-6, 1.0, 1e6]


NETWORKS = {
    "random": lambda: awake(SIZES["tiny"](), torch.float32),
    "trained": lambda: open_network(BUILTIN_TOKENS),
}
"""One with every part of the large ones, and the one that is shipped."""


def lit(emission: float) -> SceneBatch:
    """Return a scene all of whose triangles emit so much, and the brightest other materials."""
    scene = random_scene(20, num_views=1, dtype=torch.float32)
    material = torch.ones_like(scene.material_TM)
    material[:, 7:] = math.log10(1 + emission)
    return batch_scenes([dataclasses.replace(scene, material_TM=material)])


@pytest.mark.parametrize("name", NETWORKS)
def test_no_matrix_product_comes_near_the_end_of_float16(name: str) -> None:
    """Of every linear layer and convolution, so of every type with fewer digits after it."""
    network, peaks = NETWORKS[name](), dict[str, float]()

    def note(name: str, module: nn.Module, given: object, output: Tensor) -> None:
        peaks[name] = output.abs().max().item()

    kinds = nn.Linear | nn.Conv2d | nn.ConvTranspose2d
    layers = {name: each for name, each in network.named_modules() if isinstance(each, kinds)}
    for name, layer in layers.items():
        layer.register_forward_hook(functools.partial(note, name))
    for emission in EMISSIONS:
        with torch.no_grad():
            network(lit(emission), 64)
        assert peaks.keys() == layers.keys()
        highest = max(peaks, key=lambda name: peaks[name])
        # norms keep every sum near its inputs' size; a hundredth of the range leaves room for
        # training
        assert peaks[highest] < HALF_FLOAT_MAX / 100, (emission, highest)


@pytest.mark.parametrize("family", FAMILIES)
def test_pictures_and_gradients_are_finite(family: str) -> None:
    model = awake(tiny_config(family), torch.float32)
    for emission in EMISSIONS:
        model.zero_grad()
        picture = model(lit(emission), 32)
        (picture - 6.0).abs().mean().backward()
        assert torch.isfinite(picture).all(), emission
        for name, weight in model.named_parameters():
            assert weight.grad is not None, name
            assert torch.isfinite(weight.grad).all(), (emission, name)


@pytest.mark.parametrize("distance", [1.0, 30.0, MAX_NETWORK_M])
def test_angles_keep_their_digits_to_the_farthest_position(distance: float) -> None:
    rotary = TriangleRotary(num_freqs=6, max_freq=11.0, head_width=128)
    exact = TriangleRotary(num_freqs=6, max_freq=11.0, head_width=128).double()
    positions = distance * torch.linspace(-1, 1, 9 * 64).reshape(64, 3, 3)
    for got, expected in zip(rotary(positions), exact(positions.double()), strict=True):
        # half an ulp of the angle, distance x 11, and one of the sine
        bound = distance * 11 * 2.0**-24 + 1.2e-7
        assert (got - expected).abs().max() < bound


def test_a_vertex_beyond_is_refused_with_its_distance() -> None:
    scene = toy_scene(0)
    positions = scene.vertex_positions.copy()
    positions[0, 0] = np.nextafter(np.float32(MAX_NETWORK_M), np.float32(np.inf))
    at_the_end = positions.copy()
    at_the_end[0, 0] = -MAX_NETWORK_M
    scene_tensors(dataclasses.replace(scene, vertex_positions=at_the_end))
    with pytest.raises(TrilightError, match="a vertex stands 1000 m from the origin"):
        scene_tensors(dataclasses.replace(scene, vertex_positions=positions))
    positions[0, 0] = np.nan
    with pytest.raises(TrilightError, match="a vertex stands nan m from the origin"):
        scene_tensors(dataclasses.replace(scene, vertex_positions=positions))


@pytest.mark.parametrize("keys", [1, 16384])
@pytest.mark.parametrize(
    ("dtype", "tolerance"),
    # a mean over all keys, in each type's own rounding of numbers of size 1
    [(torch.float32, 1e-6), (torch.bfloat16, 1e-2)],
)
def test_attention_over_one_and_over_16384_keys(
    keys: int, dtype: torch.dtype, tolerance: float
) -> None:
    generator = torch.Generator().manual_seed(keys)
    q = torch.randn(1, 2, 3, 16, generator=generator).to(dtype)
    k, v = (torch.randn(1, 2, keys, 16, generator=generator).to(dtype) for _ in range(2))
    expected = attend_reference(q.double(), k.double(), v.double(), None)
    got = attend(q, k, v, None)
    assert got.dtype == dtype
    torch.testing.assert_close(got.double(), expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_saturated_softmax_picks_one_key(dtype: torch.dtype) -> None:
    """Scores apart by far more than a type's exponent range in exp()."""
    q = torch.full((1, 1, 2, 4), 300.0, dtype=dtype)
    k = torch.stack([torch.full((4,), x) for x in (-300.0, 0.0, 300.0)])[None, None].to(dtype)
    v = torch.eye(3)[None, None].to(dtype)
    q.requires_grad_()
    got = attend(q, k, v, None)
    got.float().square().sum().backward()
    assert got[0, 0].tolist() == [[0, 0, 1], [0, 0, 1]]
    assert q.grad is not None and torch.isfinite(q.grad).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
def test_norms_of_nothing_and_of_the_largest_are_finite(dtype: torch.dtype) -> None:
    norm = Norm(64, eps=LAYER_NORM_EPS)
    for size in (0.0, 1e-7, 1.0, 1e4):
        x = torch.full((2, 64), size, dtype=dtype, requires_grad=True)
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # torch warns where it leaves its fused kernel
            got = norm(x)
        got.float().sum().backward()
        assert got.dtype == dtype, "the type of the input, whatever that of the weight"
        assert torch.isfinite(got).all()
        assert x.grad is not None and torch.isfinite(x.grad).all()
    assert torch.all(norm(torch.zeros(2, 64, dtype=dtype)) == 0)
