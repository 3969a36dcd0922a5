"""Scenes of several lengths packed give what they give padded behind a mask, and its gradients.

On a card the kernel is torch's; here its slow twin, sequence after sequence, so all around it runs.
"""

import pytest
import torch
from torch import Tensor

from model import encoded_scene
from model.packing import pack_lengths, packed
from model.renderformer import RenderFormer
from model.scene_tensors import SceneBatch, batch_scenes
from tests.for_each import for_each
from tests.model.kit import FAMILIES, RESOLUTION, awake, random_scene, tiny_config

LENGTHS = (5, 9, 1)


def _batch() -> SceneBatch:
    return batch_scenes([random_scene(length, seed=length) for length in LENGTHS])


def _results(model: RenderFormer, batch: SceneBatch) -> dict[str, Tensor]:
    model.zero_grad()
    picture = model(batch, RESOLUTION)
    picture.square().sum().backward()
    weights = {name: weight.grad for name, weight in model.named_parameters()}
    return {"picture": picture.detach(), **{k: v for k, v in weights.items() if v is not None}}


@for_each("family", FAMILIES)
def test_a_packed_batch_is_the_padded_one(family: str, monkeypatch: pytest.MonkeyPatch) -> None:
    model, batch = awake(tiny_config(family)), _batch()
    padded = _results(model, batch)
    monkeypatch.setattr(encoded_scene, "takes_packed", lambda *_: True)
    monkeypatch.setattr("model.attention.scaled_dot_product_attention", _forbid_masks)
    for name, found in _results(model, batch).items():
        wanted = padded[name]
        assert (found - wanted).abs().max() <= 1e-11 * wanted.abs().max().clamp(min=1), name


def _forbid_masks(q: Tensor, k: Tensor, v: Tensor, attn_mask: Tensor | None) -> Tensor:
    assert attn_mask is None, "nothing that is padded is attended with a mask"
    return torch.nn.functional.scaled_dot_product_attention(q, k, v)


def test_packing_keeps_what_exists_and_gradients_go_back_there() -> None:
    packing = pack_lengths(LENGTHS, 9, torch.device("cpu"))
    x = torch.arange(27.0).reshape(3, 9, 1).requires_grad_()
    exists = torch.arange(9) < torch.tensor(LENGTHS)[:, None]
    there = packed(x, packing)
    assert torch.equal(there.detach(), x.detach()[exists])
    starts_S1, longest = packing.sequences
    assert starts_S1.tolist() == [0, 5, 14, 15] and longest >= 9
    assert packing.of_views(2).starts_S1.tolist() == [0, 5, 14, 15, 20, 29, 30]
    (there * there.detach()).sum().backward()
    assert x.grad is not None
    assert torch.equal(x.grad[..., 0], x.detach()[..., 0] * exists)


def test_where_a_mask_says_more_than_lengths_there_is_a_mask() -> None:
    batch = _batch()
    assert batch.num_triangles == LENGTHS
    alone = batch_scenes([random_scene(5), random_scene(5)])
    assert alone.num_triangles is None and alone.is_triangle_BT is None
