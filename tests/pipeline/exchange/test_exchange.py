"""Sampled scenes and published ones through USD, RenderFormer's JSON and HDF5, and back."""

import itertools
from pathlib import Path

from pipeline.builds.named import named_build
from pipeline.scenes.pool import PooledAsset
from scene_templates.layout_rand import scene_plan
from scene_templates.settings import SceneSettings
from storage.records.scene import Scene
from tests.for_each import for_each
from tests.pipeline.exchange.exchange_kit import (
    assert_h5_keeps_light,
    assert_json_keeps_light,
    assert_usd_keeps_all,
    h5_and_back,
    json_and_back,
)
from tests.pipeline.scenes.example_scenes import EXAMPLES, example_scene
from tests.pipeline.scenes.small_pool import first_scene

TEMPLATES = {"plane", "wall", "corner", "open_box"}


def test_sampled_scenes_come_back(pool: list[PooledAsset], tmp_path: Path) -> None:
    """Rooms with a colour a triangle, smooth objects, emitters that reflect, all four templates."""
    suffixes = itertools.cycle((".usdc", ".usdz", ".usda"))
    for build, templates in (("renderformer-v1-256", TEMPLATES), ("benchmark-v1", {"open_box"})):
        for template, scene in _of_each(named_build(build).scenes, pool, templates).items():
            folder = tmp_path / build / template
            folder.mkdir(parents=True)
            assert_usd_keeps_all(scene, folder, next(suffixes))
            back, _ = json_and_back(scene, folder)
            assert_json_keeps_light(back, scene)
            if build != "benchmark-v1" and template == "plane":
                # once, since textures of 53 kB a triangle are slow to pack
                assert_h5_keeps_light(h5_and_back(scene, folder), scene)


def _of_each(
    settings: SceneSettings, pool: list[PooledAsset], templates: set[str]
) -> dict[str, Scene]:
    """Return the first scene of each template."""
    found: dict[str, Scene] = {}
    for index in range(40):
        template = scene_plan(settings, seed=1, scene_index=index).family.template
        if template in templates - set(found):
            found[template] = first_scene(settings, pool, seed=1, scene_index=index)
    assert set(found) == templates
    return found


@for_each("name", EXAMPLES)
def test_published_scenes_come_back(shared: Path, tmp_path: Path, name: str) -> None:
    scene = example_scene(shared, name)
    assert_usd_keeps_all(scene, tmp_path, ".usdc")
    if scene.num_triangles < 1000:  # textures of 53 kB a triangle are slow to pack
        assert_h5_keeps_light(h5_and_back(scene, tmp_path), scene)
    back, lost = json_and_back(scene, tmp_path)
    assert_json_keeps_light(back, scene)
    if scene.num_triangles > 6000:
        return
    again, lost_again = json_and_back(back, tmp_path)
    assert_json_keeps_light(again, back)
    assert len(lost_again) <= len(lost)
