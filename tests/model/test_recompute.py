"""Recomputing activations changes what is kept, and nothing else."""

import torch

from model.scene_tensors import batch_scenes
from tests.for_each import for_each
from tests.model.kit import FAMILIES, RESOLUTION, awake, random_scene, tiny_config


@for_each("family", FAMILIES)
def test_gradients_are_the_same_bit_by_bit(family: str) -> None:
    model = awake(tiny_config(family))
    batch = batch_scenes([random_scene(3, seed=1), random_scene(5, seed=2)])
    results = []
    for wanted in (False, True):
        model.recompute_activations(wanted)
        model.zero_grad()
        picture = model(batch, RESOLUTION)
        picture.square().sum().backward()
        gradients = {name: weight.grad for name, weight in model.named_parameters()}
        results.append((picture.detach(), gradients))
    (picture, gradients), (again, gradients_again) = results
    assert torch.equal(picture, again)
    for name, gradient in gradients.items():
        again = gradients_again[name]
        assert gradient is not None and again is not None, name
        assert torch.equal(gradient, again), name


def test_less_is_kept_for_the_way_back() -> None:
    model = awake(tiny_config())
    batch = batch_scenes([random_scene(40)])
    kept = []
    for wanted in (False, True):
        model.recompute_activations(wanted)
        sizes: list[int] = []

        def keep(tensor: torch.Tensor, sizes: list[int] = sizes) -> torch.Tensor:
            sizes.append(tensor.numel())
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            model(batch, RESOLUTION)
        kept.append(sum(sizes))
    assert kept[1] < 0.5 * kept[0]
