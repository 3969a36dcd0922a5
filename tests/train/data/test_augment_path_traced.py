"""Every symmetry proved with Mitsuba: the transformed scene, path traced, shows what it says.

Two estimates of the same picture are compared block by block with their own standard errors. The
original is sampled in independent passes; each pass goes through the symmetry as training would
send it, so that the errors are transformed along.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.renderer import set_threads
from pipeline.renders.variant import activate, choose_variant
from storage.conventions import radiance_from_log10
from storage.records.lights import light_rows
from storage.records.scene import Scene
from storage.seeds import rng_for
from tests.for_each import for_each
from tests.pipeline.renders.sampling import Estimate, assert_agree, camera_of, render_blocks
from tests.pipeline.renders.scene_kit import sampled_like_scene
from tests.train.data.test_augment import scene_behind
from tests.train.toy import toy_sample
from train.data.augment import augment_scene
from train.data.scenes import TrainingScene, training_scene
from train.settings import AugmentationSettings

RESOLUTION, BLOCK, PASSES, SPP = 32, 4, 16, 64

SYMMETRIES = {
    "mirror": AugmentationSettings(mirror=True),
    "channels": AugmentationSettings(channels=True),
    "vertex order": AugmentationSettings(vertex_order=True),
    "rotation of the recipe": AugmentationSettings(rotation="recipe", translation=0.25),
    "any rotation": AugmentationSettings(rotation="uniform"),
    "light scale": AugmentationSettings(light_scale=4.0),
    "light mix": AugmentationSettings(light_mix=8.0),
    "all at once": AugmentationSettings(
        rotation="uniform",
        translation=0.25,
        mirror=True,
        channels=True,
        vertex_order=True,
        light_scale=2.0,
        light_mix=4.0,
    ),
}


@pytest.fixture(scope="module", autouse=True)
def mitsuba() -> None:
    activate(choose_variant())
    set_threads(2)


def scene_of_many_lights() -> Scene:
    """Glossy, coloured, with lights of different colours, so that every symmetry shows."""
    for index in range(100):
        scene = sampled_like_scene(rng_for(index, "symmetry"), num_views=1)
        if len(light_rows(scene)) == 3:
            break
    rows = light_rows(scene)
    materials = scene.materials.copy()
    colours = rng_for(3, "colours").uniform(0.3, 1, (len(rows), 3))
    for row, colour in zip(rows, colours, strict=True):
        of_light = scene.material_index[scene.object_index == row]
        materials[of_light[0], 7:] *= colour
    return dataclasses.replace(scene, materials=materials.astype(np.float32))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scene_of_many_lights()


@pytest.fixture(scope="module")
def passes(scene: Scene, mitsuba: None) -> NDArray[np.float32]:
    """[PASSES, L, R, R, 3]: independent pictures of each light alone."""
    tracer = load_tracer(scene, max_depth=10, rr_depth=5)
    camera = camera_of(scene, RESOLUTION)
    lights = [tracer.only_light(row) for row in light_rows(scene)]
    return np.stack(
        [
            np.stack([light.radiance(camera, seed=1000 + k, spp=SPP) for light in lights])
            for k in range(PASSES)
        ]
    )


def transformed(
    scene: Scene, lights_LRR3: NDArray[np.float32], symmetry: Callable[..., TrainingScene]
) -> TrainingScene:
    sample = dataclasses.replace(
        toy_sample(0, views=1),
        scene=scene,
        radiance_rgb=lights_LRR3.sum(axis=0)[None],
        lights_rgb=lights_LRR3[None],
    )
    return symmetry(training_scene(sample, RESOLUTION, lights_apart=True))


@pytest.mark.slow("statistics")
@for_each("name", sorted(SYMMETRIES))
def test_the_path_traced_picture_is_the_transformed_one(
    name: str, scene: Scene, passes: NDArray[np.float32]
) -> None:
    seed = next(s for s in range(9) if rng_for(s, "draw").random() < 0.5)  # a visit that mirrors

    def symmetry(training: TrainingScene) -> TrainingScene:
        return augment_scene(training, SYMMETRIES[name], rng_for(seed, "draw"))

    visits = [transformed(scene, lights, symmetry) for lights in passes]
    pictures = np.array([radiance_from_log10(v.target_VRR3[0].double()) for v in visits])
    count = RESOLUTION // BLOCK
    blocks = pictures.reshape(PASSES, count, BLOCK, count, BLOCK, 3).mean(axis=(2, 4))
    expected = Estimate(
        mean=blocks.mean(axis=0), error=blocks.std(axis=0, ddof=1) / np.sqrt(PASSES)
    )
    other = scene_behind(visits[0], scene)
    other.check()
    estimate = render_blocks(other, resolution=RESOLUTION, block=BLOCK, passes=PASSES)
    # float32 positions and log10(1 + x): relative 1e-4 covers both
    assert_agree(estimate, expected, slack=1e-4)
    if name not in ("vertex order", "rotation of the recipe", "any rotation"):
        untouched = render_blocks(scene, resolution=RESOLUTION, block=BLOCK, passes=PASSES)
        with pytest.raises(AssertionError, match="of what is allowed"):
            assert_agree(estimate, untouched)
    assert torch.isfinite(visits[0].target_VRR3).all()
