"""The figures of layers are those of a slow twin, and only of the update that was asked for."""

import copy
import math

import numpy as np
import pytest
import torch
from torch import nn

from model.config import smoke
from model.renderformer import RenderFormer
from tests.for_each import for_each
from tests.train.kit import tiny_run
from tests.train.toy import toy_sample
from train.data.buckets import make_batch
from train.data.scenes import training_scene
from train.loop.crew import Crew
from train.loop.state import new_state
from train.loop.step import Stepper
from train.loss.objective import Objective
from train.watching.layers import LayerNorms, layer_of


def test_layers_are_named_for_people() -> None:
    names = {layer_of(name) for name, _ in RenderFormer(smoke()).named_parameters()}
    assert {"encoder.tokens", "encoder.layers.1", "decoder.layers.3", "decoder.head"} <= names
    assert len(names) < 20, "a row of the log stays short"
    assert layer_of("weight") == "weight"
    assert layer_of("a.b.c.3") == "a.b"


@for_each("clip", [1e9, 1e-3])
def test_the_figures_are_those_of_an_update_before_clipping(clip: float) -> None:
    settings = tiny_run(grad_clip=clip)
    state = new_state(settings)
    stepper = Stepper(
        state, settings, Objective(settings.loss, None), Crew(device=torch.device("cpu"))
    )
    batch = make_batch([training_scene(toy_sample(index), 16) for index in range(2)])
    before = copy.deepcopy(dict(state.model.named_parameters()))
    stepper.layers.expect(True)
    report = stepper.step([batch], 3e-3)
    row = stepper.layers.row()
    squared: dict[str, np.ndarray] = {}
    for name, weight in state.model.named_parameters():
        old, new = (w.detach().double().numpy().ravel() for w in (before[name], weight))
        sums = squared.setdefault(layer_of(name), np.zeros(2))
        sums += [old @ old, (new - old) @ (new - old)]
    assert row.keys() == squared.keys()
    for layer, (_, weight_norm, ratio) in row.items():
        length = math.sqrt(squared[layer][0])
        # four digits are kept
        assert weight_norm == pytest.approx(length, rel=1e-3)
        assert ratio == pytest.approx(math.sqrt(squared[layer][1]) / length, rel=1e-3)
    whole = math.sqrt(sum((grad or 0) ** 2 for grad, _, _ in row.values()))
    assert whole == pytest.approx(report.grad_norm, rel=1e-3)
    stepper.step([batch], 3e-3)
    assert stepper.layers.row() == {}, "nobody asked for this update"


def test_a_gradient_that_is_not_finite_is_none_and_a_missing_one_is_nothing() -> None:
    model = nn.Sequential(nn.Linear(2, 1, bias=False), nn.Linear(1, 1, bias=False))
    layers = LayerNorms(model)
    layers.expect(True)
    model[0].weight.grad = torch.full((1, 2), math.inf)
    layers.gradients()
    layers.updated()
    seen = layers.unread()
    assert seen is not None
    layers.read(seen.flatten().tolist())
    row = layers.row()
    assert row["0.weight"][0] is None
    assert row["1.weight"][0] == 0 == row["1.weight"][2]
