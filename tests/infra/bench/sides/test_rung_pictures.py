"""The rungs without a network show exactly what a network that has learned nothing is given."""

import dataclasses

import numpy as np

from infra.bench.sides.rung_pictures import (
    lamps_rung,
    network_rung,
    physics_alone,
    timed_rung,
    untaught,
)
from model.config import hits_smoke
from tests.train.toy import toy_scene

SCENE = toy_scene(2)
PX = 16


def shown(rung: object) -> np.ndarray:
    return rung(SCENE)(SCENE.c2w[0], float(SCENE.fov_deg[0]))  # type: ignore[operator]


def test_light_of_lamps_is_what_is_left_when_nothing_is_gathered() -> None:
    of_lamps = shown(lamps_rung(PX))
    config = dataclasses.replace(hits_smoke(), gather_rays=0)
    # the network's picture went through log10(1 + radiance) in float32
    np.testing.assert_allclose(
        of_lamps, shown(network_rung(untaught(config), PX)), rtol=1e-4, atol=1e-5
    )
    assert of_lamps.max() > 0.01
    everything = shown(network_rung(physics_alone(), PX))
    assert everything.mean() > of_lamps.mean(), "other surfaces send light too"


def test_the_smallest_layers_show_what_large_ones_show() -> None:
    small = shown(network_rung(physics_alone(), PX))
    unfiltered = dataclasses.replace(hits_smoke(), filter_width=0)
    large = shown(network_rung(untaught(unfiltered), PX))
    np.testing.assert_allclose(small, large, rtol=1e-3, atol=1e-4)  # sums in another order


def test_a_first_view_costs_more_than_a_further_one() -> None:
    found = timed_rung(network_rung(physics_alone(), PX), SCENE)
    assert 0 < found.further_s < found.first_s
    assert found.radiance_rgb.shape == (PX, PX, 3)
