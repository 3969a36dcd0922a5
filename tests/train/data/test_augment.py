"""Law of every symmetry: rendering the transformed scene gives the transformed picture.

First by the toy's renderer, which knows nothing of symmetries: pixels on an edge may fall on either
side of it by rounding, so at most 1 % of them may differ. Then below a sky. That the path tracer
has these symmetries is a law of its own (tests/laws).
"""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from model.hits.tracing import lit_scenes
from model.hits.view_inputs import Channel, view_inputs
from model.scene_tensors import SceneTensors, batch_scenes, scene_tensors
from storage.errors import TrilightError
from storage.records.sample import StoredSample, encode_sample, stored_sample
from storage.records.scene import Scene
from storage.seeds import rng_for
from tests.for_each import for_each
from tests.model.hits.kit import corner, rays, textured
from tests.model.kit import hits_config, tensors_of, tiny_config
from tests.pipeline.renders.scene_kit import join, light, material, quad
from tests.sky_maps import constant, smooth
from tests.train.kit import bare_scene, plain_run
from tests.train.toy import toy_picture, toy_sample
from train.data.augment import (
    augment_scene,
    mirror_scene,
    move_scene,
    permute_channels,
    random_rotation,
    rotate_vertex_order,
    scale_light,
)
from train.data.bad_samples import BadSampleCounter
from train.data.loader import _SceneMaker
from train.data.scenes import TrainingScene, training_scene
from train.settings import AugmentationSettings

RESOLUTION = 32
FLOOR = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]

EVERYTHING = AugmentationSettings(
    rotation="uniform",
    translation=0.25,
    mirror=True,
    channels=True,
    vertex_order=True,
    light_scale=3.0,
)

Symmetry = Callable[[TrainingScene], TrainingScene]

SYMMETRIES: dict[str, Symmetry] = {
    "mirror": mirror_scene,
    "channels": lambda scene: permute_channels(scene, np.array([2, 0, 1])),
    "vertices": lambda scene: rotate_vertex_order(
        scene, np.arange(scene.tensors.num_triangles) % 3
    ),
    "motion": lambda scene: move_scene(
        scene, random_rotation("uniform", rng_for(0, "turn")), torch.tensor([3.0, -1.0, 0.5])
    ),
    "light": lambda scene: scale_light(scene, 2.5),
    "rotation of the recipe": lambda scene: augment_scene(
        scene, AugmentationSettings(rotation="recipe", translation=0.25), rng_for(0, "augment")
    ),
    "all at random": lambda scene: augment_scene(scene, EVERYTHING, rng_for(0, "augment")),
}


def scene_behind(training: TrainingScene, original: Scene) -> Scene:
    """Return a Scene with the geometry, materials and cameras of training tensors."""
    tensors = training.tensors
    materials = tensors.material_TM.numpy().copy()
    materials[:, 7:] = 10 ** materials[:, 7:] - 1
    return dataclasses.replace(
        original,
        vertex_positions=tensors.triangles_T33.reshape(-1, 3).numpy(),
        vertex_normals=tensors.normals_T33.reshape(-1, 3).numpy(),
        faces=np.arange(3 * tensors.num_triangles, dtype=np.uint32).reshape(-1, 3),
        material_index=np.arange(tensors.num_triangles, dtype=np.uint16),
        materials=materials,
        c2w=tensors.c2w_V44.numpy(),
        fov_deg=tensors.fov_deg_V.numpy(),
    )


@for_each("name", sorted(SYMMETRIES))
@for_each("index", [0, 1, 3, 8])
def test_the_picture_of_the_transformed_scene_is_the_transformed_picture(
    name: str, index: int
) -> None:
    sample = toy_sample(index, resolution=RESOLUTION)
    transformed = SYMMETRIES[name](training_scene(sample, RESOLUTION))
    a, b, c = transformed.tensors.triangles_T33.unbind(1)
    facing = torch.cross(b - a, c - a, dim=-1) * transformed.tensors.normals_T33[:, 0]
    assert torch.all(facing.sum(-1) > 0), "winding still agrees with the normals"
    scene = scene_behind(transformed, sample.scene)
    scene.check()  # among others: poses stay rotations, normals stay unit
    for view in range(scene.num_views):
        expected = np.log10(1 + toy_picture(scene, view, RESOLUTION))
        got = transformed.target_VRR3[view].numpy()
        # float32 positions: shading moves by a millionth, except on edges
        differs = np.abs(got - expected).max(axis=-1) > 1e-4
        assert differs.mean() < 0.01
        assert expected.std() > 0.01, "an empty picture would prove nothing"


def test_mixed_lights_the_sky_last_and_their_pictures_are_as_much_stronger() -> None:
    """A picture is the sum of what each light gives alone, in proportion to its emission."""
    lamps = [light([[x, 0, 2], [x + 1, 0, 2], [x, 1, 2]], 3.0 + x) for x in (0, 1)]
    lit = join([quad(FLOOR, material(diffuse=0.5)), *lamps])
    lit = dataclasses.replace(lit, environment=constant(0.25))
    alone = rng_for(0, "lights").uniform(0, 9, (1, 3, 16, 16, 3)).astype(np.float32)
    whole = {"scene": lit, "radiance_rgb": alone.sum(axis=1), "lights_rgb": alone}
    sample = dataclasses.replace(toy_sample(0, views=1), **whole)
    scene = training_scene(sample, 16, lights_apart=True)
    mixed = augment_scene(scene, AugmentationSettings(light_mix=8.0), rng_for(0, "mix"))
    before, after = (10 ** each.tensors.material_TM[:, 7:] - 1 for each in (scene, mixed))
    assert not before[:2].any() and not after[:2].any(), "the floor stays dark"
    sky = mixed.tensors.sky
    assert sky is not None
    factors = np.append((after / before)[2:, 0].numpy(), sky.radiance_rgb.mean() / 0.25)
    assert factors.max() > 1.1 * factors.min() and np.ptp(sky.radiance_rgb) < 1e-6
    expected = np.log10(1 + np.einsum("l,vlijc->vijc", factors, alone))
    # float32 logarithms
    np.testing.assert_allclose(mixed.target_VRR3, expected, rtol=1e-4)
    np.testing.assert_allclose(after[2:].numpy(), before[2:].numpy() * factors[:2, None], rtol=1e-4)


def test_mirroring_twice_is_nothing_and_the_original_is_left_alone() -> None:
    scene = training_scene(toy_sample(2), 16)
    again = mirror_scene(mirror_scene(scene))
    assert torch.equal(again.target_VRR3, scene.target_VRR3)
    for name, value in tensors_of(scene.tensors).items():
        assert torch.equal(getattr(again.tensors, name), value), name
    copies = {name: value.clone() for name, value in tensors_of(scene.tensors).items()}
    target = scene.target_VRR3.clone()
    augment_scene(scene, EVERYTHING, rng_for(1, "augment"))
    assert torch.equal(scene.target_VRR3, target)
    assert all(torch.equal(getattr(scene.tensors, name), copies[name]) for name in copies)
    same = augment_scene(scene, AugmentationSettings(), rng_for(1, "augment"))
    assert same is scene


def test_uniform_rotations_favour_no_direction_and_the_recipe_favours_none_at_all() -> None:
    """Of a rotation uniform on SO(3) the trace has mean 0 and variance 1; small turns raise it."""
    rng = rng_for(0, "rotations")
    traces = {
        kind: np.array([float(random_rotation(kind, rng).trace()) for _ in range(1500)])
        for kind in ("uniform", "recipe")
    }
    # five standard errors of 1500 draws: 5 / sqrt(1500) = 0.13
    assert abs(traces["uniform"].mean()) < 0.13
    assert abs(traces["uniform"].var() - 1) < 0.2  # fourth moment 3: 5 sqrt(2 / 1500) = 0.18
    assert traces["recipe"].mean() > 0.3
    for kind in ("uniform", "recipe"):
        turned = random_rotation(kind, rng)
        torch.testing.assert_close(turned @ turned.T, torch.eye(3).double())
        assert turned.det().item() == pytest.approx(1)
    assert torch.equal(random_rotation("none", rng), torch.eye(3).double())


ORDER = np.array([2, 0, 1])


def _pixels(tensors: SceneTensors, **changes: int) -> NDArray:
    """Return what rays find of the first view, 32 pixels wide."""
    (lit,) = lit_scenes(batch_scenes([tensors]))
    camera = tensors.c2w_V44[0].numpy(), float(tensors.fov_deg_V[0])
    seed = changes.pop("seed", 0)
    return view_inputs(lit, *camera, 32, rays(gather_rays=0, **changes), seed)[0]


def _direct(tensors: SceneTensors) -> NDArray:
    """Return the mean of the direct light of several noises, at four pixels by four."""
    found = [_pixels(tensors, sky_rays=8, seed=seed) for seed in range(6)]
    mean = np.mean([each[..., Channel.SHOWN_DIFFUSE] for each in found], axis=0)
    return mean.reshape(8, 4, 8, 4, 3).mean(axis=(1, 3))


@for_each("symmetry", ["turned", "mirrored", "channels"])
def test_textures_go_through_the_symmetries_of_training(symmetry: str) -> None:
    tensors = scene_tensors(textured())
    training = bare_scene(tensors)
    if symmetry == "turned":
        turn = np.random.default_rng(1).integers(0, 3, tensors.num_triangles)
        changed = rotate_vertex_order(training, turn)
    elif symmetry == "mirrored":
        changed = mirror_scene(training)
    else:
        changed = permute_channels(training, ORDER)
    before, after = (
        _pixels(each, rays_a_side=1)[..., Channel.DIFFUSE] for each in (tensors, changed.tensors)
    )
    if symmetry == "mirrored":
        after = after[:, ::-1]
    elif symmetry == "channels":
        before = before[..., ORDER]
    assert before.std() > 0.05
    assert np.mean(np.abs(before - after).max(axis=-1) > 1e-3) < 0.01  # rims


@for_each("symmetry", ["moved", "mirrored", "channels", "scaled"])
def test_a_sky_goes_through_the_symmetries_of_training(symmetry: str) -> None:
    tensors = scene_tensors(corner(sky=smooth(), radiance=0.0))
    training, before = bare_scene(tensors), _direct(tensors)
    if symmetry == "moved":
        rotation = random_rotation("uniform", np.random.default_rng(0))
        after = _direct(move_scene(training, rotation, torch.tensor([0.4, -0.1, 0.2])).tensors)
    elif symmetry == "mirrored":
        mirrored = mirror_scene(training)
        after = _direct(mirrored.tensors)[:, ::-1]
        twice = mirror_scene(mirrored).tensors.sky
        assert twice is not None and tensors.sky is not None
        assert np.array_equal(twice.radiance_rgb, tensors.sky.radiance_rgb)
    elif symmetry == "channels":
        after = _direct(permute_channels(training, ORDER).tensors)
        before = before[..., ORDER]
    else:
        after = _direct(scale_light(training, 3.0).tensors) / np.float32(3)
    # The noise goes along, but behind a mirror: there 48 rays and more of 16 pixels differ by 3 %.
    most = 0.06 if symmetry == "mirrored" else 0.005
    assert before.std() > 0.05
    assert np.median(np.abs(after / np.maximum(before, 1e-3) - 1)[before > 0.05]) < most
    assert after.mean() == pytest.approx(before.mean(), rel=most / 4)


def _below_a_sky() -> StoredSample:
    sample = toy_sample(0)
    below = dataclasses.replace(sample.scene, environment=smooth())
    return stored_sample("0", encode_sample(dataclasses.replace(sample, scene=below)))


@for_each(
    ("config", "is_known"),
    [
        (tiny_config(), False),
        (hits_config(), False),
        (hits_config(sky_rays=2), True),
    ],
)
def test_training_takes_skies_that_its_network_knows(config: object, is_known: bool) -> None:
    settings = plain_run(
        seed=0, shuffle_shards=1, scenes_per_step=1, resolution=16, views_per_scene=1, model=config
    )  # fmt: skip
    rng = np.random.default_rng(0)
    maker = _SceneMaker(None, None, settings, BadSampleCounter(0))  # type: ignore[arg-type]
    if is_known:
        assert maker._draw_views(_below_a_sky(), rng).tensors.sky is not None
        return
    with pytest.raises(TrilightError, match="this network does not know its light"):
        maker._draw_views(_below_a_sky(), rng)
