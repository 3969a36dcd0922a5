"""Far from the defaults: scenes still keep every law, or are rejected with a reason."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from pipeline.builds.named import BUILDS, named_build
from pipeline.scenes.compose import compose_scene
from pipeline.scenes.pool import PooledAsset
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.settings import SceneSettings
from storage.errors import Rejected
from storage.records.scene import Scene
from storage.settings.changes import changed
from tests.extremes.range_examples import SCENE_REASONS, naming
from tests.pipeline.scenes.scene_facts import counts_of, digest, rows_of
from tests.pipeline.scenes.small_pool import first_scene

SETTINGS = SceneSettings(families=DEFAULT_FAMILIES)

EXTREMES: list[dict[str, Any]] = [
    {"cameras.fov_deg": [100.0, 110.0]},
    {"cameras.fov_deg": [10.0, 12.0]},
    {"cameras.distance": [1.0, 1.0]},
    {"cameras.distance": [4.0, 4.0], "views.min_coverage": 0.001},
    {"lights.count": [32, 32], "lights.spacing": 0.0},
    {"lights.count": [1, 1]},
    {"lights.scale": [0.01, 0.01]},
    {"lights.scale": [10.0, 10.0], "lights.total_emission": [1e-3, 1e-3]},
    {"lights.total_emission": [1e9, 1e9]},
    {"lights.coloured_share": 1.0, "lights.orientation": "euler"},
    {
        "families.num_objects": [8, 8],
        "families.object_scale": [0.4, 0.6],
        "max_triangles": 16384,
        "enough_error": 0.0,
    },
    {"families.num_objects": [8, 8], "placement.overlap_share": 1.0, "max_triangles": 4096},
    {"families.num_objects": [0, 0]},
    {"families.object_scale": [0.01, 0.01], "views.min_coverage": 0.0},
    {"families.object_scale": [2.9, 2.9], "placement.inside": False, "views.min_depth": 0.0},
    {"families.shell.tilt_deg": 10.0, "families.shell.square_share": 0.0},
    {"families.shell.scale": [0.2, 0.2], "placement.inside": False},
    {"families.shell.scale": [3.0, 3.0], "views.max_shell_back": 1.0},
    {"families.smooth_share": 1.0, "materials.coloured_share": 1.0},
    {"families.smooth_share": 1.0, "materials.smooth_angle_deg": 180.0},
    {"families.smooth_share": 1.0, "materials.smooth_angle_deg": 0.0},
    {"materials.roughness_log": [0.06, 0.06]},
    {"materials.coloured_specular_share": 1.0, "materials.specular_ratio": [1.0, 1.0]},
    {"materials.albedo_sum": [1.0, 1.0]},
    {"materials.albedo_sum": [0.0, 0.0]},
    {"num_views": 16, "views.coverage_grid": 5},
    {"fill_to": 1536, "enough_error": 1.0},
]


def _require_laws(scene: Scene, settings: SceneSettings) -> None:
    scene.check()
    assert scene.num_views == settings.num_views
    assert scene.num_triangles <= settings.max_triangles
    counts = counts_of(scene)
    assert counts["shell"] % 128 == 0
    assert settings.lights.count[0] <= counts["emitter"] <= settings.lights.count[1]


def test_extreme_settings_keep_the_laws(pool: list[PooledAsset]) -> None:
    for changes in EXTREMES:
        settings = changed(SETTINGS, changes)
        for index, seed in enumerate((0, 2**63)):
            with naming(f"{changes}"):
                scene = first_scene(settings, pool, seed=seed, scene_index=index)
                _require_laws(scene, settings)


BEYOND: list[dict[str, Any]] = [
    {"families.object_scale": [1e-3, 1e-3], "views.min_coverage": 0.0},
    {"families.object_scale": [1e-3, 1e-3], "placement.overlap_share": 1.0},
    {"families.object_scale": [1e3, 1e3], "placement.inside": False},
    {"families.shell.scale": [1e-3, 1e-3]},
    {"families.shell.scale": [1e3, 1e3]},
    {"lights.scale": [1e-3, 1e-3], "lights.distance": [1e3, 1e3]},
    {"lights.scale": [1e3, 1e3]},
    {"lights.distance": [1e-3, 1e-3], "lights.target_jitter": 0.0},
    {"lights.total_emission": [1e-3, 1e-3], "lights.count": [64, 64], "lights.spacing": 0.0},
    {"cameras.distance": [1e-3, 1e-3], "cameras.target_jitter": 0.0},
    {"cameras.distance": [1e3, 1e3], "cameras.target_jitter": 1e3},
    {"cameras.fov_deg": [170.0, 170.0]},
    {"cameras.fov_deg": [1.0, 1.0], "cameras.up_jitter": 1.0},
]
"""Settings that are admitted, and of which few rooms can be (ends one by one: test_range_ends)."""


def test_absurd_settings_give_scenes_or_reasons(pool: list[PooledAsset]) -> None:
    for changes in BEYOND:
        settings = changed(SETTINGS, changes)
        for index in range(2):
            with naming(f"{changes}"):
                try:
                    scene = compose_scene(settings, pool, seed=0, scene_index=index, attempt=0)
                except Rejected as rejection:
                    assert rejection.reason in SCENE_REASONS
                else:
                    _require_laws(scene, settings)


LAST = 999_999_998
FAR = [(0, LAST), (2**63, LAST), (2**64 + 1, 30), (2**200, 10**9 + 7)]
"""Seeds and indices."""


def test_far_seeds_and_indices_are_seeds_and_indices(pool: list[PooledAsset]) -> None:
    """Beyond 32 and 64 bits; a sample's name holds indices of nine digits."""
    for number, build in enumerate(BUILDS):
        settings = named_build(build, changes={"scenes.num_views": 1}).scenes
        seed, index = FAR[number % len(FAR)]
        with naming(build, f"{seed}", f"{index}"):
            scene = first_scene(settings, pool, seed=seed, scene_index=index)
            _require_laws(scene, settings.of_scene(index))
            assert scene.provenance["scene_index"] == index


def test_far_seeds_and_indices_have_scenes_of_their_own(pool: list[PooledAsset]) -> None:
    settings = named_build("pretrain-256", changes={"scenes.num_views": 1}).scenes
    first, again = (
        [digest(first_scene(settings, pool, seed=seed, scene_index=index)) for seed, index in FAR]
        for _ in range(2)
    )
    assert first == again
    assert len(set(first)) == len(FAR)


def _one_triangle(pool: list[PooledAsset]) -> PooledAsset:
    """An object that is one triangle at its only level: open, flat, seen from two sides."""
    entry = pool[1]
    level = dataclasses.replace(
        entry.asset.levels[0],
        positions=np.array([[-0.5, -0.4, 0], [0.5, -0.4, 0], [0, 0.4, 0]], np.float32),
        faces=np.array([[0, 1, 2]], np.uint32),
    )
    return PooledAsset(locked=entry.locked, asset=dataclasses.replace(entry.asset, levels=(level,)))


@pytest.mark.parametrize(
    "changes",
    [
        {"views.min_coverage": 0.0},
        {"views.min_coverage": 0.0, "placement.overlap_share": 1.0},
        {"views.min_coverage": 0.0, "families.smooth_share": 1.0, "materials.coloured_share": 1.0},
        {"views.min_coverage": 0.0, "fill_to": 1536},
    ],
    ids=["apart", "overlapping", "smooth", "filled"],
)
def test_objects_of_one_triangle_compose(
    pool: list[PooledAsset], changes: Mapping[str, Any]
) -> None:
    settings = changed(SETTINGS, changes)
    for index in range(3):
        scene = first_scene(settings, [_one_triangle(pool)], seed=0, scene_index=index)
        _require_laws(scene, settings)
        objects = len(rows_of(scene, "object"))
        if settings.fill_to is None:
            assert counts_of(scene)["object"] == objects
        else:
            assert scene.num_triangles > 1536 - 3 * objects


@pytest.mark.parametrize("build", ["pretrain-256", "out-of-range"])
def test_a_pool_of_one_object_fills_every_scene(pool: list[PooledAsset], build: str) -> None:
    settings = named_build(build, changes={"scenes.num_views": 1}).scenes
    for entry in (pool[1], pool[4]):
        for index in range(30, 32):
            scene = first_scene(settings, [entry], seed=0, scene_index=index)
            _require_laws(scene, settings.of_scene(index))
            assert {scene.objects[row].uid for row in rows_of(scene, "object")} <= {
                entry.locked.uid
            }
            names = [entry.name for entry in scene.objects]
            assert len(set(names)) == len(names)


def test_a_pool_of_one_object_that_is_too_large_is_rejected_at_every_attempt(
    pool: list[PooledAsset],
) -> None:
    """With reason and numbers, sixteen times over, instead of for ever."""
    large = [dataclasses.replace(pool[0], asset=_finest_only(pool[0]))]
    settings = changed(SETTINGS, {"max_triangles": 1300})
    for attempt in range(16):
        with pytest.raises(Rejected, match="at least 1280 triangles") as caught:
            compose_scene(settings, large, seed=0, scene_index=0, attempt=attempt)
        assert caught.value.reason == "over_budget"


def _finest_only(entry: PooledAsset) -> Any:
    return dataclasses.replace(entry.asset, levels=entry.asset.levels[:1])
