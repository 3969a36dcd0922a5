"""Laws of the way in: numbers arrive where they belong, and nothing is written to the scene."""

import dataclasses

import numpy as np
import torch

from model.scene_tensors import batch_scenes, scene_tensors, tensors_of
from storage.records.environment import Environment
from storage.records.material import EMISSION, material_width
from storage.records.scene import ARRAY_FIELDS
from tests.model.kit import random_scene
from tests.train.toy import toy_scene


def test_every_triangle_carries_its_own_vertices_normals_and_material() -> None:
    scene = toy_scene(0)
    tensors = scene_tensors(scene)
    assert tensors.num_triangles == scene.num_triangles
    assert tensors.num_views == scene.num_views
    for row in range(scene.num_triangles):
        corners = scene.faces[row]
        material = scene.materials[scene.material_index[row]]
        np.testing.assert_array_equal(tensors.triangles_T33[row], scene.vertex_positions[corners])
        np.testing.assert_array_equal(tensors.normals_T33[row], scene.vertex_normals[corners])
        np.testing.assert_array_equal(tensors.material_TM[row, :7], material[:7])
        emission = 10.0 ** tensors.material_TM[row, 7:].double().numpy() - 1
        # emission of 20 through a float32 logarithm
        np.testing.assert_allclose(emission, material[EMISSION], atol=1e-4)
    assert tensors.material_TM.shape[1] == material_width()
    assert all(value.dtype == torch.float32 for value in tensors_of(tensors).values())


def test_the_scene_stays_as_it_was_and_shares_no_memory() -> None:
    scene = toy_scene(1)
    before = {name: getattr(scene, name).copy() for name in ARRAY_FIELDS}
    tensors = scene_tensors(scene)
    for value in tensors_of(tensors).values():
        value.fill_(-1)
    for name, array in before.items():
        np.testing.assert_array_equal(getattr(scene, name), array, err_msg=name)


def test_batches_are_padded_with_zeros_to_the_longest_and_no_further() -> None:
    scenes = [random_scene(3, seed=1), random_scene(7, seed=2), random_scene(5, seed=3)]
    batch = batch_scenes(scenes)
    assert batch.triangles_BT33.shape[1] == 7
    assert batch.is_triangle_BT is not None
    assert batch.is_triangle_BT.sum(1).tolist() == [3, 7, 5]
    for row, scene in enumerate(scenes):
        length = scene.num_triangles
        for name in ("triangles", "normals", "material"):
            suffix = "M" if name == "material" else "33"
            padded = getattr(batch, f"{name}_BT{suffix}")[row]
            assert torch.equal(padded[:length], getattr(scene, f"{name}_T{suffix}"))
            assert torch.all(padded[length:] == 0)


def test_equal_lengths_need_no_mask() -> None:
    batch = batch_scenes([random_scene(4, seed=1), random_scene(4, seed=2)])
    assert batch.is_triangle_BT is None


def test_a_black_sky_is_none() -> None:
    for height, radiance, is_there in ((2, 1.0, True), (2, 0.0, False), (1, 0.0, False)):
        texels = np.full((height, 2 * height, 3), radiance, np.float32)
        scene = dataclasses.replace(toy_scene(0), environment=Environment(radiance_rgb=texels))
        batch = batch_scenes([scene_tensors(scene)])
        assert (batch.skies is not None) == is_there
