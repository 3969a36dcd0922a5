"""Rust covers the share that is drawn; threads that are too fine to show keep their mean."""

import numpy as np
import pytest

from scene_templates.surfaces.draw import SurfaceMapSettings, draw_surface
from scene_templates.surfaces.made import exceeded_by
from scene_templates.surfaces.texels import Texels
from storage.seeds import rng_for
from tests.for_each import for_each


@for_each("share", [0.0, 0.1, 0.5, 1.0])
def test_a_level_is_exceeded_by_its_share(share: float) -> None:
    noise = Texels(64).noise(rng_for(0, "noise"), (4, 4), octaves=3)
    # of 4,096 values, the one at the level itself does not exceed it
    assert (noise > exceeded_by(noise, share)).mean() == pytest.approx(share, abs=2 / 4096)


def test_a_coarse_map_of_fabric_has_the_colour_of_a_fine_one() -> None:
    for seed in range(2):
        means = [
            draw_surface(
                rng_for(seed, "surface"), SurfaceMapSettings(families=("fabric",), size=size)
            ).diffuse_rgb.mean((0, 1), dtype=float)
            for size in (64, 256)
        ]
        # two texels a thread have a mean of 1/4 where the curve has 1/3, and no fluff: 4 % and 2 %
        np.testing.assert_allclose(means[0], means[1], rtol=0.08)
