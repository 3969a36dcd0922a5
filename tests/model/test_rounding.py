"""Weights rounded together are those that autocast rounds one by one; gradients too."""

import pytest
import torch
from torch import Tensor

from model import rounding
from model.scene_tensors import batch_scenes
from tests.for_each import for_each
from tests.model.kit import RESOLUTION, awake, random_scene, tiny_config


@for_each("recompute", [False, True])
@for_each("family", ["linear", "dpt"])
def test_rounding_together_changes_no_bit(
    family: str, recompute: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = awake(tiny_config(family), dtype=torch.float32)
    model.recompute_activations(recompute)
    scenes = [random_scene(n, seed=n, dtype=torch.float32) for n in (3, 5)]
    rounded: list[int] = []

    def results() -> dict[str, Tensor]:
        model.zero_grad()
        with torch.autocast("cpu", torch.bfloat16):
            picture = model(batch_scenes(scenes), RESOLUTION)
        picture.square().sum().backward()
        grads = {name: weight.grad for name, weight in model.named_parameters()}
        return {"picture": picture.detach(), **{k: v for k, v in grads.items() if v is not None}}

    together = rounding._copies

    def counted(tensors: tuple[Tensor, ...], to: torch.dtype) -> tuple[Tensor, ...]:
        rounded.append(len(tensors))
        return together(tensors, to)

    monkeypatch.setattr(rounding, "_copies", counted)
    found = results()
    layers = len(model.encoder.layers) + len(model.decoder.layers) + (family == "dpt")
    assert len(rounded) == 2 * layers, "once forth and once back for each layer, and the head"
    monkeypatch.setattr(rounding, "_rounded", lambda *_: {})
    alone = results()
    assert found.keys() == alone.keys()
    for name, value in found.items():
        assert torch.equal(value, alone[name]), name


def test_without_autocast_nothing_is_rounded() -> None:
    layer = torch.nn.Linear(3, 3)
    assert rounding.rounded_weights(layer, torch.device("cpu")) == {}
    assert rounding.rounded_weights(layer, torch.device("meta")) == {}
