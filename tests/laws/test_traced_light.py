"""What networks are told of light is what the path tracer finds: direct, and by one bounce."""

import numpy as np
import pytest

from model.hits.view_inputs import Channel
from storage.records.environment import Environment
from storage.records.scene import Scene
from tests.model.hits.kit import corner, direct, traced
from tests.pipeline.renders.sampling import Estimate, assert_agree, render_blocks
from tests.pipeline.renders.scene_kit import open_scene
from tests.sky_maps import night, one_sun, smooth

PASSES = 12

SKIES = {"smooth": smooth(), "sun": one_sun(1e5), "night": night()}


def _traced_blocks(scene: Scene, part: slice | None, passes: int = PASSES) -> Estimate:
    """Return the means of 4 x 4 pixels over several noises, with their standard errors."""
    pictures = []
    for seed in range(passes):
        inputs = traced(scene, 32, seed=seed)
        picture = direct(inputs) if part is None else inputs.pixels[..., part]
        pictures.append(picture.reshape(8, 4, 8, 4, 3).mean(axis=(1, 3)))
    cells = np.array(pictures, np.float64)
    return Estimate(mean=cells.mean(axis=0), error=cells.std(axis=0, ddof=1) / np.sqrt(passes))


def _require_alike(ours: Estimate, theirs: Estimate, of_mean: float) -> None:
    """Pixels are sampled on a grid of 2 x 2 and not all over: at rims, 3 % of a block of 16."""
    at_rims = 0.03 * theirs.mean.max()
    assert_agree(Estimate(mean=ours.mean, error=np.hypot(ours.error, at_rims)), theirs)
    both = np.hypot(ours.error, theirs.error)
    error = float(np.sqrt(np.square(both).sum()) / both.size)
    apart = abs(float(ours.mean.mean() - theirs.mean.mean()))
    assert apart < 5 * error + of_mean * float(theirs.mean.mean())


@pytest.mark.parametrize("roughness", [0.15, 1.0])
def test_direct_light_is_that_of_paths_of_two_edges(llvm: None, roughness: float) -> None:
    scene = corner(roughness=roughness)
    ours = _traced_blocks(scene, None)
    theirs = render_blocks(scene, max_depth=2, passes=8)
    _require_alike(ours, theirs, of_mean=0.005)


@pytest.mark.slow("statistics")
@pytest.mark.parametrize("sky", SKIES.values(), ids=SKIES.keys())
@pytest.mark.parametrize("num_lights", [0, 2])
def test_direct_light_of_a_sky_is_that_of_paths_of_two_edges(
    llvm: None, sky: Environment, num_lights: int
) -> None:
    """With lamps beside it, and without any."""
    scene = open_scene(sky, num_lights)
    ours = _traced_blocks(scene, None, passes=24)
    theirs = render_blocks(scene, max_depth=2, passes=8)
    _require_alike(ours, theirs, of_mean=0.01)


def test_diffuse_light_of_other_surfaces_is_that_of_longer_paths(llvm: None) -> None:
    """Without gloss nothing is simplified: gathered light times albedo is all indirect light.

    But for what is mixed between anchors: so there is one for each pixel, and means are compared.
    """
    scene = corner()
    materials = scene.materials.copy()
    materials[:, 3:6] = 0
    scene = type(scene)(**{**vars(scene), "materials": materials})
    found = [traced(scene, 32, anchors_a_side=32, gather_rays=32, seed=k) for k in range(3)]
    ours = np.mean(
        [
            x.pixels[..., Channel.COVERAGE]
            * x.pixels[..., Channel.DIFFUSE]
            * x.gathered.reshape(32, 32, 3)
            for x in found
        ]
    )
    whole = render_blocks(scene, max_depth=10, passes=6).mean
    short = render_blocks(scene, max_depth=2, passes=6).mean
    # radiosity of triangles as large as the floor for the light of the third edge on: 4 %
    assert ours == pytest.approx((whole - short).mean(), rel=0.04)
