"""Random colours of scene files: the published stream where its order is known."""

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh

from storage.records.material import DIFFUSE
from tests.pipeline.scenes.example_scenes import corners_of, example_scene
from tests.pipeline.scenes.one_box import MATERIAL, built, described, loaded


def test_the_random_colours_of_compose_scene_are_the_published_ones(
    shared: Path,
) -> None:
    """Draw as the published converter does: a triple for each part of the split triangle soup."""
    scene = example_scene(shared, "compose-scene")
    path = shared / "renderformer_scenes/objects/compose/obj0.obj"
    mesh = trimesh.load_mesh(path, process=False)
    soup = trimesh.Trimesh(
        vertices=mesh.triangles.reshape(-1, 3),
        faces=np.arange(3 * len(mesh.faces)).reshape(-1, 3),
        process=False,
    )
    generator = np.random.RandomState(42)
    drawn = [
        (part.triangles[0], generator.randint(0, math.ceil(256 * 0.5), (1, 3))[0] / 255)
        for part in soup.split(only_watertight=False)
    ]
    assert len(drawn) == 224
    mine = scene.object_index == 1
    found = scene.materials[scene.material_index[mine], DIFFUSE]
    for triangle, corners, colour in zip(drawn, corners_of(scene, 1), found, strict=True):
        np.testing.assert_allclose(corners, triangle[0], atol=1e-7)  # float32 of at most 0.5
        np.testing.assert_allclose(colour, triangle[1], atol=1e-7)


@pytest.mark.parametrize(("kind", "count"), [("per-triangle", 256), ("per-shading-group", 3)])
def test_random_colours_of_a_smooth_mesh(kind: str, count: int) -> None:
    rod = trimesh.creation.cylinder(0.3, 1.0, sections=64)  # two caps, and one side of 128
    change = {"rand_tri_diffuse_seed": 7, "random_diffuse_type": kind}
    scene = built(described(*MATERIAL, **change), loaded(rod))
    mine = scene.object_index == 0
    colours = scene.materials[scene.material_index[mine], DIFFUSE]
    different, rows = np.unique(colours, axis=0, return_inverse=True)
    assert len(different) == count
    assert 0 < colours.max() <= 0.5
    if count == 3:
        assert sorted(np.bincount(rows)) == [64, 64, 128]
    assert not np.array_equal(
        built(
            described(*MATERIAL, **{**change, "rand_tri_diffuse_seed": 8}), loaded(rod)
        ).materials,
        scene.materials,
    )
