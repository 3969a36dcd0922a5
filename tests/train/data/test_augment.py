"""Law of every symmetry: rendering the transformed scene gives the transformed picture.

The renderer is the toy one, which knows nothing of symmetries. Pixels on an edge may fall on
either side of it by rounding: at most 1 % of them may differ.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import torch

from model.scene_tensors import tensors_of
from storage.records.scene import Scene
from storage.seeds import rng_for
from tests.for_each import for_each
from tests.train.toy import toy_picture, toy_sample
from train.data.augment import (
    augmented,
    mirrored,
    moved,
    rotation_rand,
    with_channels,
    with_light_scaled,
    with_vertices_turned,
    with_views,
)
from train.data.scenes import TrainingScene, training_scene
from train.settings import AugmentationSettings

RESOLUTION = 32

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
    "mirror": mirrored,
    "channels": lambda scene: with_channels(scene, np.array([2, 0, 1])),
    "vertices": lambda scene: with_vertices_turned(
        scene, np.arange(scene.tensors.num_triangles) % 3
    ),
    "views": lambda scene: with_views(scene, np.array([1])),
    "motion": lambda scene: moved(
        scene, rotation_rand("uniform", rng_for(0, "turn")), torch.tensor([3.0, -1.0, 0.5])
    ),
    "light": lambda scene: with_light_scaled(scene, 2.5),
    "all at random": lambda scene: augmented(scene, EVERYTHING, rng_for(0, "augment")),
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
@for_each("index", [0, 3, 8])
def test_the_picture_of_the_transformed_scene_is_the_transformed_picture(
    name: str, index: int
) -> None:
    sample = toy_sample(index, resolution=RESOLUTION)
    transformed = SYMMETRIES[name](training_scene(sample, RESOLUTION))
    scene = scene_behind(transformed, sample.scene)
    scene.check()  # among others: poses stay rotations, normals stay unit
    for view in range(scene.num_views):
        expected = np.log10(1 + toy_picture(scene, view, RESOLUTION))
        got = transformed.target_VRR3[view].numpy()
        # float32 positions: shading moves by a millionth, except on edges
        differs = np.abs(got - expected).max(axis=-1) > 1e-4
        assert differs.mean() < 0.01
        assert expected.std() > 0.01, "an empty picture would prove nothing"


@for_each("name", sorted(SYMMETRIES))
def test_winding_still_agrees_with_the_normals(name: str) -> None:
    training = SYMMETRIES[name](training_scene(toy_sample(1), 8))
    a, b, c = training.tensors.triangles_T33.unbind(1)
    facing = torch.cross(b - a, c - a, dim=-1) * training.tensors.normals_T33[:, 0]
    assert torch.all(facing.sum(-1) > 0)


def test_a_turned_vertex_takes_its_normal_along() -> None:
    scene = training_scene(toy_sample(1), 8)
    count = scene.tensors.num_triangles
    numbered = torch.arange(9.0 * count).reshape(count, 3, 3)
    tensors = dataclasses.replace(scene.tensors, triangles_T33=numbered, normals_T33=-numbered)
    scene = dataclasses.replace(scene, tensors=tensors)
    turned = with_vertices_turned(scene, np.arange(count) % 3).tensors
    assert torch.equal(turned.triangles_T33, -turned.normals_T33)
    for row in range(count):
        assert torch.equal(turned.triangles_T33[row], numbered[row].roll(-(row % 3), dims=0))


def test_mirroring_twice_is_nothing() -> None:
    scene = training_scene(toy_sample(2), 16)
    again = mirrored(mirrored(scene))
    assert torch.equal(again.target_VRR3, scene.target_VRR3)
    for name, value in tensors_of(scene.tensors).items():
        assert torch.equal(getattr(again.tensors, name), value), name


def test_the_original_is_left_alone() -> None:
    scene = training_scene(toy_sample(2), 16)
    copies = {name: value.clone() for name, value in tensors_of(scene.tensors).items()}
    target = scene.target_VRR3.clone()
    augmented(scene, EVERYTHING, rng_for(1, "augment"))
    assert torch.equal(scene.target_VRR3, target)
    assert all(torch.equal(getattr(scene.tensors, name), copies[name]) for name in copies)


def test_uniform_rotations_favour_no_direction_and_the_recipe_favours_none_at_all() -> None:
    """Of a rotation uniform on SO(3) the trace has mean 0 and variance 1; small turns raise it."""
    rng = rng_for(0, "rotations")
    traces = {
        kind: np.array([float(rotation_rand(kind, rng).trace()) for _ in range(1500)])
        for kind in ("uniform", "recipe")
    }
    # five standard errors of 1500 draws: 5 / sqrt(1500) = 0.13
    assert abs(traces["uniform"].mean()) < 0.13
    assert abs(traces["uniform"].var() - 1) < 0.2  # fourth moment 3: 5 sqrt(2 / 1500) = 0.18
    assert traces["recipe"].mean() > 0.3
    turned = rotation_rand("uniform", rng)
    torch.testing.assert_close(turned @ turned.T, torch.eye(3).double())
    assert turned.det().item() == pytest.approx(1)
    assert torch.equal(rotation_rand("none", rng), torch.eye(3).double())


def test_what_is_left_out_changes_nothing() -> None:
    scene = training_scene(toy_sample(2), 16)
    same = augmented(scene, AugmentationSettings(), rng_for(1, "augment"))
    assert same is scene
