"""Tokens of a sky: none without one, exact where it is exact, and refused where it is not known."""

import warnings
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from model.light_groups import light_groups
from model.neural_renderer import NeuralRenderer
from model.renderformer import RenderFormer, radiance
from model.scene_tensors import SceneTensors, batch_scenes, converted, scene_tensors
from storage.errors import TrilightError
from storage.records.environment import Environment
from tests.for_each import for_each
from tests.model.hits.kit import corner
from tests.model.hits.test_decoder import hits_config
from tests.model.kit import awake, render, tiny_config
from tests.sky_maps import constant, one_sun, six_poles, smooth


def _below(sky: Environment | None, radiance: float = 30.0) -> SceneTensors:
    return scene_tensors(corner(radiance=radiance, sky=sky))


def _network(sky_cells: int = 48, **changes: Any) -> RenderFormer:
    return awake(tiny_config(sky_cells=sky_cells, **changes), torch.float32)


def test_a_scene_without_a_sky_has_none_of_them() -> None:
    network = _network()
    plain = _network(0)
    state = {n: w for n, w in network.state_dict().items() if not n.startswith("encoder.sky.")}
    plain.load_state_dict(state)
    assert torch.equal(render(network, _below(None)), render(plain, _below(None)))
    black = constant(0.0)
    assert torch.equal(render(network, _below(black)), render(plain, _below(None)))
    batch = batch_scenes([_below(None)])
    assert network.encode(batch).places.num_registers == network.config.num_registers


@for_each("count", [48, 192])
def test_a_sky_is_seen_and_company_changes_nothing(count: int) -> None:
    network = _network(count)
    under = [_below(smooth()), _below(None), _below(six_poles())]
    alone = [render(network, each)[0] for each in under]
    together = render(network, *under)
    for one, other in zip(alone, together, strict=True):
        assert torch.allclose(one, other, atol=2e-6)  # other matrix products, as with padding
    assert (alone[0] - alone[1]).abs().max() > 1e-3
    assert (alone[0] - alone[2]).abs().max() > 1e-4
    encoded = network.encode(batch_scenes(under))
    registers = network.config.num_registers
    assert [encoded.only(row).places.num_registers for row in range(3)] == [
        registers + count, registers, registers + count
    ]  # fmt: skip


def test_empty_bundles_are_skipped_below_a_sky() -> None:
    network = _network()
    batch = batch_scenes([_below(None), _below(smooth())])
    encoded = network.encode(batch)
    with torch.no_grad():
        picture = network.decode(encoded, batch.cameras, 32, skip_empty_bundles=True)
    assert torch.isfinite(picture).all() and picture.abs().max() > 0


@for_each("sky", [one_sun(1e6), constant(3.0, height=1)])
def test_any_sky_makes_finite_pictures_without_lamps(sky: Environment) -> None:
    """With tokens of a sky; see hits/test_sky_light for its rays."""
    network = _network()
    assert torch.isfinite(render(network, _below(sky, 0.0))).all()
    shown = NeuralRenderer(network).render(corner(radiance=0.0, sky=sky), 32)
    assert np.isfinite(shown).all() and shown.max() > 0


def test_all_parts_learn_with_a_sky_and_have_gradients_without() -> None:
    network = _network(texture_cells=4)
    for sky, is_zero in ((smooth(), False), (None, True)):
        network.zero_grad()
        network(batch_scenes([_below(sky)]), 32).square().sum().backward()
        assert all(weight.grad is not None for weight in network.parameters())
        gradient = network.encoder.sky.cell.weight.grad
        assert (gradient.abs().max() == 0) == is_zero


def test_tokens_move_with_the_batch() -> None:
    network = _network().double()
    batch = converted(batch_scenes([_below(smooth())]), lambda each: each.double())
    with torch.no_grad():
        assert network(batch, 32).dtype == torch.float64


@for_each(
    ("config", "setting"),
    [(tiny_config(), "model.sky_cells=48"), (hits_config(), "model.sky_rays=16")],
)
def test_networks_that_know_no_sky_refuse_it_and_say_so_when_rendering(
    config: Any, setting: str
) -> None:
    network = awake(config, torch.float32)
    with pytest.raises(TrilightError, match=f"does not know its light.*{setting}.*share=0"):
        render(network, _below(smooth()))
    below = corner(sky=smooth())
    with pytest.warns(UserWarning, match="does not know: it is missing here"):
        shown = NeuralRenderer(network).render(below, 32)
    assert np.array_equal(shown, NeuralRenderer(network).render(corner(), 32))


def test_a_sky_that_cameras_see_is_refused_and_left_black() -> None:
    network = _network()
    seen = corner(sky=smooth(is_seen=True))
    with pytest.raises(TrilightError, match=r"cameras see its environment.*seen_share=0"):
        render(network, scene_tensors(seen))
    with pytest.warns(UserWarning, match="networks leave it black"):
        shown = NeuralRenderer(network).render(seen, 32)
    hidden = corner(sky=smooth())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.array_equal(shown, NeuralRenderer(network).render(hidden, 32))


def test_a_sky_lights_one_group_of_lamps_alone() -> None:
    from tests.pipeline.renders.test_sky_paths import open_scene

    scene = open_scene(smooth())
    groups = light_groups(scene, 1)
    assert [group.scene.environment is None for group in groups] == [False, True]
    sky = groups[0].scene.environment
    assert sky is not None and scene.environment is not None
    apart = sky.radiance_rgb * groups[0].share - scene.environment.radiance_rgb
    assert np.abs(apart).max() < 1e-6  # float32
    dark = open_scene(smooth(), 0)
    assert light_groups(dark, 1)[0].scene is dark


def _linear(log10: Tensor) -> Tensor:
    return radiance(log10.double())


def test_hits_scale_with_all_light_exactly() -> None:
    """The sky is in the scene's unit, as lamps are: ten times the light, ten times the picture."""
    network = awake(hits_config(sky_rays=2, sky_cells=48), torch.float32)
    once = _linear(render(network, _below(constant(0.4), 20.0)))
    tenfold = _linear(render(network, _below(constant(4.0), 200.0)))
    # float32 throughout; log10(1 + x) of the darkest pixels has the fewest digits
    assert ((tenfold - 10 * once).abs() < 2e-4 * tenfold + 2e-5).all()
