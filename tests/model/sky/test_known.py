"""Skies in networks: refused where none is known, and exactly in proportion where they are."""

import warnings

import numpy as np
import pytest
import torch
from torch import Tensor

from model.config import ModelConfig
from model.neural_renderer import NeuralRenderer
from model.renderformer import RenderFormer, radiance
from model.scene_tensors import SceneTensors, scene_tensors
from storage.errors import TrilightError
from storage.records.environment import Environment
from tests.for_each import for_each
from tests.model.hits.kit import corner
from tests.model.hits.test_decoder import hits_config
from tests.model.kit import awake, render, tiny_config
from tests.sky_maps import constant, smooth


def _below(sky: Environment | None, radiance: float = 30.0) -> SceneTensors:
    return scene_tensors(corner(radiance=radiance, sky=sky))


def _network() -> RenderFormer:
    return awake(hits_config(sky_rays=2), torch.float32)


@for_each("config", [tiny_config(), hits_config()])
def test_networks_that_know_no_sky_refuse_it_and_say_so_when_rendering(config: ModelConfig) -> None:
    network = awake(config, torch.float32)
    with pytest.raises(TrilightError, match=r"does not know its light.*sky_rays=16.*share=0"):
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


def _linear(log10: Tensor) -> Tensor:
    return radiance(log10.double())


def test_hits_scale_with_all_light_exactly() -> None:
    """The sky is in the scene's unit, as lamps are: ten times the light, ten times the picture."""
    network = _network()
    once = _linear(render(network, _below(constant(0.4), 20.0)))
    tenfold = _linear(render(network, _below(constant(4.0), 200.0)))
    # float32 throughout; log10(1 + x) of the darkest pixels has the fewest digits
    assert ((tenfold - 10 * once).abs() < 2e-4 * tenfold + 2e-5).all()
