"""The methods without a network show exactly what a network that has learned nothing is given."""

import dataclasses

import numpy as np

from infra.rendering.methods import (
    direct_light_method,
    network_method,
    timed_method,
    traced_network,
    untrained_network,
)
from model.config import hits_smoke
from tests.train.toy import toy_scene

SCENE = toy_scene(2)
PX = 16


def shown(method: object) -> np.ndarray:
    return method(SCENE)(SCENE.c2w[0], float(SCENE.fov_deg[0]))  # type: ignore[operator]


def test_light_of_lamps_is_what_is_left_when_nothing_is_gathered() -> None:
    of_lamps = shown(direct_light_method(PX))
    config = dataclasses.replace(hits_smoke(), gather_rays=0)
    # the network's picture went through log10(1 + radiance) in float32
    np.testing.assert_allclose(
        of_lamps, shown(network_method(untrained_network(config), PX)), rtol=1e-4, atol=1e-5
    )
    assert of_lamps.max() > 0.01
    everything = shown(network_method(traced_network(), PX))
    assert everything.mean() > of_lamps.mean(), "other surfaces send light too"


def test_the_smallest_layers_show_what_large_ones_show() -> None:
    small = shown(network_method(traced_network(), PX))
    unfiltered = dataclasses.replace(hits_smoke(), filter_width=0)
    large = shown(network_method(untrained_network(unfiltered), PX))
    np.testing.assert_allclose(small, large, rtol=1e-3, atol=1e-4)  # sums in another order


def test_a_first_view_costs_more_than_a_further_one() -> None:
    found = timed_method(network_method(traced_network(), PX), SCENE)
    assert 0 < found.further_s < found.first_s
    assert found.radiance_rgb.shape == (PX, PX, 3)
