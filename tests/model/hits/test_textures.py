"""Textures in what is traced for a network: exact at every hit, whatever its symmetries did."""

import numpy as np
import torch
from numpy.typing import NDArray

from model.hits.lit_scene import LitScene
from model.hits.radiosity import scene_light
from model.hits.textures import surface_textures
from model.hits.tracing import TracedScene, traced_batch
from model.hits.view_inputs import Channel, ViewInputs, view_inputs
from model.scene_tensors import SceneTensors, batch_scenes, scene_tensors
from storage.records.first_hits import first_hits
from storage.records.scene import Scene
from tests.for_each import for_each
from tests.model.hits.kit import corner, textured, traced
from train.data.augment import mirrored, with_channels, with_vertices_turned
from train.data.scenes import TrainingScene


def _traced(scene: Scene, rays_a_side: int = 2) -> ViewInputs:
    lit = LitScene(
        scene.vertex_positions[scene.faces],
        scene.vertex_normals[scene.faces],
        scene.materials[scene.material_index],
        surface_textures(scene),
    )
    return view_inputs(
        lit,
        scene_light(lit),
        scene.c2w[0],
        float(scene.fov_deg[0]),
        32,
        rays_a_side=rays_a_side,
        anchors_a_side=8,
        gather_rays=16,
    )


def test_a_pixel_has_the_material_at_its_hit() -> None:
    scene = textured()
    hits = first_hits(scene, resolution=32)
    pixels = _traced(scene, rays_a_side=1).pixels
    met = hits.met
    same = met & (pixels[..., 0] > 0)
    assert same.sum() > 0.99 * met.sum()
    # Places of hits are float32 here and float64 there: 1e-6 m is 1e-5 of a texel.
    apart = np.abs(pixels[..., Channel.DIFFUSE] - hits.material[..., 0:3]).max(axis=-1)[same]
    assert np.mean(apart > 1e-4) < 0.005
    apart = np.abs(pixels[..., Channel.ROUGHNESS][..., 0] - hits.material[..., 6])[same]
    assert np.mean(apart > 1e-4) < 0.005
    assert hits.material[same][:, 0].std() > 0.1


def test_every_ray_of_a_textured_pixel_counts() -> None:
    """The albedo of a pixel is the mean over its rays, not that of one of them."""
    scene = textured(roughness=False)
    fine = first_hits(scene, resolution=64).material[..., 0:3]
    means = np.asarray(fine).reshape(32, 2, 32, 2, 3).mean(axis=(1, 3))
    found = _traced(scene).pixels
    whole = np.isfinite(means).all(axis=-1) & (found[..., 0] == 1)
    apart = np.abs(found[..., Channel.DIFFUSE] - means).max(axis=-1)[whole]
    assert np.median(apart) < 1e-4 and np.mean(apart > 0.02) < 0.05  # rims: other rays meet


def test_plain_triangles_of_a_textured_scene_and_plain_scenes_stay() -> None:
    plain, scene = corner(), textured()
    assert surface_textures(plain) is None
    without, there = traced(plain).pixels, _traced(scene).pixels
    wall = first_hits(scene, resolution=32).material[..., 6] == 1.0
    for channel in (Channel.DIFFUSE, Channel.NORMAL, Channel.POSITION):
        apart = np.abs(without[..., channel] - there[..., channel]).max(axis=-1)[wall]
        assert np.mean(apart > 1e-5) < 0.05  # at rims, the other surface is textured


@for_each("symmetry", ["turned", "mirrored", "channels"])
def test_textures_go_through_the_symmetries_of_training(symmetry: str) -> None:
    scene = textured()
    tensors = scene_tensors(scene)
    training = TrainingScene(
        key="",
        tensors=tensors,
        target_VRR3=torch.zeros(1, 4, 4, 3),
        noise_V=torch.zeros(1),
        light_T=torch.zeros(tensors.num_triangles, dtype=torch.int64),
    )
    order = np.array([2, 0, 1])
    if symmetry == "turned":
        turn = np.random.default_rng(1).integers(0, 3, tensors.num_triangles)
        changed = with_vertices_turned(training, turn)
    elif symmetry == "mirrored":
        changed = mirrored(training)
    else:
        changed = with_channels(training, order)
    before, after = (
        _albedo(traced_batch(batch_scenes([each]))[0], each) for each in (tensors, changed.tensors)
    )
    if symmetry == "mirrored":
        after = after[:, ::-1]
    elif symmetry == "channels":
        before = before[..., order]
    assert before.std() > 0.05
    assert np.mean(np.abs(before - after).max(axis=-1) > 1e-3) < 0.01  # rims


def _albedo(scene: TracedScene, tensors: SceneTensors) -> NDArray[np.float32]:
    found = view_inputs(
        scene.lit,
        scene.light,
        tensors.c2w_V44[0].numpy(),
        float(tensors.fov_deg_V[0]),
        32,
        rays_a_side=1,
        anchors_a_side=8,
        gather_rays=0,
    )
    return np.asarray(found.pixels[..., Channel.DIFFUSE])
