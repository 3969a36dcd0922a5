"""Laws of composed scenes."""

import contextlib
import json
from collections.abc import Iterable

import numpy as np
import pytest

from pipeline.builds.named import BUILDS, named_build
from pipeline.renders.load_tracer import choose_tracing_scale
from pipeline.scenes.compose import compose_scene
from pipeline.scenes.pool import PooledAsset
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.sample_layout import scene_plan
from scene_templates.settings import SceneSettings
from scene_templates.templates import TEMPLATES
from storage.errors import Rejected, TrilightError
from storage.records.scene import Scene
from storage.seeds import SceneKey
from storage.settings.changes import changed
from tests.pipeline.scenes.scene_facts import counts_of, digest, planes_of, points_of, rows_of
from tests.pipeline.scenes.small_pool import first_scene
from tests.scene_templates.balls import template_settings

SETTINGS = SceneSettings(families=DEFAULT_FAMILIES)

TOUCH = 1e-6
"""Coordinates below 2 in float32: 1.2e-7 of rounding each, three to a height."""


def test_attempts_differ_but_keep_what_was_planned(pool: list[PooledAsset]) -> None:
    for index in range(5):
        plan = scene_plan(SETTINGS, seed=0, scene_index=index)
        tries = []
        for attempt in range(4):
            with contextlib.suppress(Rejected):
                scene = compose_scene(SETTINGS, pool, SceneKey(0, index, attempt))
                tries.append(scene)
        assert len({digest(scene) for scene in tries}) == len(tries) >= 2
        for scene in tries:
            assert scene.provenance["template"] == plan.family.template
            assert scene.provenance["family"] == plan.family.name
            assert len(rows_of(scene, "object")) == plan.num_objects
            assert len(rows_of(scene, "emitter")) == plan.num_lights


@pytest.mark.parametrize("max_triangles", [532, 1536])
def test_the_budget_is_never_exceeded(pool: list[PooledAsset], max_triangles: int) -> None:
    settings = changed(SETTINGS, {"max_triangles": max_triangles, "num_views": 1})
    totals = []
    for index in range(24):
        try:
            scene = compose_scene(settings, pool, SceneKey(1, index))
        except Rejected as rejected:
            assert rejected.reason in ("over_budget", "no_camera")
            continue
        totals.append(scene.num_triangles)
        # A refined budget leaves no shell or emitter out.
        counts = counts_of(scene)
        assert counts["shell"] == TEMPLATES[scene.provenance["template"]].shell_triangles
        assert counts["emitter"] == scene_plan(settings, seed=1, scene_index=index).num_lights
        assert counts["object"] > 0
    assert max(totals) <= max_triangles
    assert len(totals) >= 10


def _require_within_budget(pool: list[PooledAsset], names: Iterable[str], scenes: int) -> None:
    """Shell and lights included; and each build has scenes that come near its budget."""
    for name in names:
        settings = named_build(name, changes={"scenes.num_views": 1}).scenes
        fullest = 0.0
        for index in range(scenes):
            most = settings.of_scene(index).max_triangles
            with contextlib.suppress(Rejected):
                scene = compose_scene(settings, pool, SceneKey(2, index))
                fullest = max(fullest, scene.num_triangles / most)
                assert choose_tracing_scale(scene) == 1, "no preset's pictures change by a size"
        # A level of the small pool is a quarter of the next finer one: little is ever left.
        assert 0.75 < fullest <= 1, (name, fullest)


def test_two_builds_keep_their_budgets(pool: list[PooledAsset]) -> None:
    _require_within_budget(pool, ("smoke", "finetune-512"), scenes=16)


@pytest.mark.slow("every")
def test_no_build_exceeds_its_budget(pool: list[PooledAsset]) -> None:
    with_maps_or_many_triangles = {"textured-256", "sky-256", "out-of-range", "out-of-range-2"}
    plain = set(BUILDS) - with_maps_or_many_triangles - {"benchmark-v1-mini"}
    _require_within_budget(pool, sorted(plain), scenes=40)
    _require_within_budget(pool, sorted(with_maps_or_many_triangles), scenes=16)


def test_scenes_keep_the_laws_of_the_record_emitters_objects_and_normals(
    scenes: list[Scene],
) -> None:
    for scene in scenes:
        scene.check()
        assert scene.num_views == SETTINGS.num_views
        assert scene.num_triangles <= SETTINGS.max_triangles
        assert json.loads(json.dumps(dict(scene.provenance))) == scene.provenance
        assert set(scene.provenance) == {
            "template",
            "family",
            "scene_index",
            "attempt",
            "seed",
            "camera_attempts",
        }
        kinds = [entry.kind for entry in scene.objects]
        assert kinds == sorted(kinds, key=("shell", "object", "emitter").index)
    for scene in scenes:
        emits = scene.triangle_emits
        rows = scene.material_index[emits]
        assert 1 <= len(rows) <= 8
        assert len(set(rows.tolist())) == len(rows)
        material = scene.materials[rows]
        assert 2500 <= material[:, 7].sum() <= 5000.01  # eight float32 roundings of up to 3e-5
        assert (material[:, 7:] == material[:, 7:8]).all()
        assert (material[:, :6] == 0).all()
        assert len(set(scene.object_index[emits].tolist())) == len(rows)
    for scene in scenes:
        planes = planes_of(scene)
        for row in rows_of(scene, "object"):
            points = points_of(scene, row)
            heights = points @ planes[:, :3].T + planes[:, 3]
            assert heights.min() > -TOUCH
            assert np.abs(points).max() < 1.2  # beside the room by half a radius at most
    for scene in scenes:
        corners = scene.vertex_positions[scene.faces].astype(np.float64)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        geometric = cross / np.linalg.norm(cross, axis=1, keepdims=True)
        facing = np.einsum("tci,ti->tc", scene.vertex_normals[scene.faces], geometric)
        assert facing.min() > 0.1 - 1e-6  # shading.LEAST_FACING, less float32 rounding


def test_rights_travel_and_names_are_unique(pool: list[PooledAsset]) -> None:
    wall = [entry for entry in pool if entry.locked.uid == "made/wall1"]
    settings = template_settings("corner", {"families.num_objects": [3, 3], "num_views": 1})
    scene = compose_scene(settings, wall, SceneKey(0, 0))
    objects = [entry for entry in scene.objects if entry.kind == "object"]
    assert [entry.name for entry in objects] == ["wall1_2", "wall1_3", "wall1_4"]
    for entry in objects:
        assert entry.uid == "made/wall1"
        assert entry.licence == "CC0-1.0"
        assert entry.attribution == "maker of made/wall1"
        assert entry.source_url == "https://example.org/made/wall1"


def test_an_empty_pool_is_a_users_mistake() -> None:
    with pytest.raises(TrilightError, match="pool"):
        compose_scene(SETTINGS, [], SceneKey(0, 0))


def test_a_scene_without_objects_is_a_scene(pool: list[PooledAsset]) -> None:
    """The published families have some; a view of one need not show any object."""
    settings = template_settings("open_box", {"families.num_objects": [0, 0]})
    scene = compose_scene(settings, pool, SceneKey(0, 0))
    scene.check()
    assert rows_of(scene, "object") == []
    assert len(scene.provenance["camera_attempts"]) == scene.num_views == 4


def test_real_objects_compose(real_pool: list[PooledAsset]) -> None:
    """Thin, open, doubled and many-part meshes as people publish them keep every law."""
    for index in range(12):
        scene = first_scene(SETTINGS, real_pool, seed=0, scene_index=index)
        scene.check()
        assert scene.num_triangles <= SETTINGS.max_triangles
