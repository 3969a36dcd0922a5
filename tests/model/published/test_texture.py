"""Ten numbers do what the published 13 x P x P texture did, exactly."""

import pytest
import torch
from torch import Tensor

from model.published.texture import NORMAL, TANGENT_NORMAL, TEXTURE_CHANNELS, fold, unfold

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


@pytest.mark.parametrize(("patch", "cells"), [(1, 1), (8, 43), (32, 559)])
def test_a_folded_layer_is_the_unfolded_one(patch: int, cells: int) -> None:
    weight, bias = published_layer(patch)
    material = torch.rand(4, 10, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    pictures = texture(material, patch)
    assert int((pictures[0, : patch**2] != 0).sum()) == cells
    ten, folded_bias = fold(weight, bias, patch)
    # float64 sums of 559 x 13 products of size 1
    expected = pictures @ weight.T + bias
    torch.testing.assert_close(material @ ten.T + folded_bias, expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("patch", [1, 8, 32])
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
