"""A precision rounds what it says, keeps what it must, and is refused where it has no path."""

import copy

import pytest
import torch

from model.precision import rounded_parts, set_precision, tf32
from model.scene_tensors import converted
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.model.kit import FAMILIES, awake, random_scene, render, tiny_config


@for_each("family", FAMILIES)
def test_bfloat16_rounds_the_layers_and_keeps_what_makes_tokens(family: str) -> None:
    model = set_precision(awake(tiny_config(family), torch.float32), "bfloat16")
    rounded = {id(weight) for part in rounded_parts(model) for weight in part.parameters()}
    for name, weight in model.named_parameters():
        assert weight.dtype == (torch.bfloat16 if id(weight) in rounded else torch.float32), name
    exact = {name for name, weight in model.named_parameters() if id(weight) not in rounded}
    for name in ("encoder.tokens.material.weight", "decoder.rays.weight", "encoder.registers_NW"):
        assert name in exact
    assert "decoder.head.last.weight" in exact
    assert "decoder.layers.0.ffn.up.weight" not in exact
    assert model.encoder.rotary.freqs_F.dtype == torch.float32


@for_each("family", FAMILIES)
def test_pictures_are_float32_and_near(family: str) -> None:
    exact = awake(tiny_config(family), torch.float32)
    scene = random_scene(9, dtype=torch.float32)
    expected = render(exact, scene)
    assert torch.equal(render(set_precision(exact, "float32"), scene), expected)
    got = render(set_precision(copy.deepcopy(exact), "bfloat16"), scene)
    assert got.dtype == torch.float32
    # 8 bits through some ten layers; pictures of size 1, and not equal at all
    error = (got - expected).square().mean().sqrt() / expected.std()
    assert 1e-5 < error < 5e-2


def test_positions_are_never_rounded() -> None:
    """A scene 100 m out: bfloat16 would know its positions to half a metre."""
    model = set_precision(awake(tiny_config(), torch.float32), "bfloat16")
    near = random_scene(6)
    far = copy.deepcopy(near)
    far.triangles_T33.add_(100.0)
    far.c2w_V44[:, :3, 3].add_(100.0)
    pictures = [render(model, converted(scene, torch.Tensor.float)) for scene in (near, far)]
    # the angles move by 100 x 5 / 2^24; what they turn is rounded to 8 bits, so some ulps of that
    assert (pictures[0] - pictures[1]).abs().max() < 0.1 * pictures[0].std()


@for_each("name", ["tf32", "float16"])
def test_what_a_cpu_has_no_path_for_is_refused(name: str) -> None:
    with pytest.raises(TrilightError, match=f"precision {name}: the network is on cpu"):
        set_precision(awake(tiny_config(), torch.float32), name)


def test_an_unknown_precision_is_refused() -> None:
    with pytest.raises(TrilightError, match="float8.*expected one of float32, bfloat16"):
        set_precision(awake(tiny_config(), torch.float32), "float8")


def test_tf32_is_set_for_a_while_only() -> None:
    before = torch.backends.cuda.matmul.fp32_precision
    for allowed, expected in ((True, "tf32"), (False, "ieee")):
        with tf32(allowed):
            assert torch.backends.cuda.matmul.fp32_precision == expected
        assert torch.backends.cuda.matmul.fp32_precision == before
