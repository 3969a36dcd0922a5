"""Sampled scenes and published ones through USD, RenderFormer's JSON and HDF5, and back."""

from pathlib import Path

import pytest

from pipeline.builds.named import named_build
from pipeline.scenes.pool import PooledAsset
from tests.pipeline.exchange.exchange_kit import (
    assert_h5_keeps_light,
    assert_json_keeps_light,
    assert_usd_keeps_all,
    h5_and_back,
    json_and_back,
)
from tests.pipeline.scenes.example_scenes import EXAMPLES, example_scene
from tests.pipeline.scenes.small_pool import first_scene

SCENES = 8
TEMPLATES = {"plane", "wall", "corner", "open_box"}
BUILDS = ("renderformer-v1-256", "benchmark-v1")


@pytest.mark.parametrize("build", BUILDS)
def test_sampled_scenes_come_back(pool: list[PooledAsset], tmp_path: Path, build: str) -> None:
    """Rooms with a colour a triangle, smooth objects, emitters that reflect, all four templates."""
    settings = named_build(build, changes={}).scenes
    seen = set()
    for index in range(SCENES):
        scene = first_scene(settings, pool, seed=1, scene_index=index)
        seen.add(scene.provenance["template"])
        folder = tmp_path / str(index)
        folder.mkdir()
        assert_usd_keeps_all(scene, folder, (".usdc", ".usdz", ".usda")[index % 3])
        back, _ = json_and_back(scene, folder)
        assert_json_keeps_light(back, scene)
        if index == 0:  # textures of 53 kB a triangle are slow to pack
            assert_h5_keeps_light(h5_and_back(scene, folder), scene)
    assert seen == TEMPLATES


@pytest.mark.parametrize("name", list(EXAMPLES))
def test_published_scenes_come_back(shared: Path, tmp_path: Path, name: str) -> None:
    scene = example_scene(shared, name)
    assert_usd_keeps_all(scene, tmp_path, ".usdc")
    if scene.num_triangles < 4000:  # textures of 53 kB a triangle are slow to pack
        assert_h5_keeps_light(h5_and_back(scene, tmp_path), scene)
    back, lost = json_and_back(scene, tmp_path)
    assert_json_keeps_light(back, scene)
    again, lost_again = json_and_back(back, tmp_path)
    assert_json_keeps_light(again, back)
    assert len(lost_again) <= len(lost)
