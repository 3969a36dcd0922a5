"""Laws of composed scenes."""

import contextlib
import dataclasses
import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.scenes.compose import compose_scene
from pipeline.scenes.pool import PooledAsset
from scene_templates.settings import SHELL_TRIANGLES, SceneSettings
from storage.errors import Rejected, TrilightError
from storage.scene import ARRAY_FIELDS, Scene
from tests.scenes.small_pool import first_scene, pooled, small_pool

SETTINGS = SceneSettings()

TOUCH = 1e-6
"""Coordinates below 2 in float32: 1.2e-7 of rounding each, three to a height."""


def digest(scene: Scene) -> str:
    sha = hashlib.sha256()
    for name in ARRAY_FIELDS:
        sha.update(getattr(scene, name).tobytes())
    sha.update(repr(scene.objects).encode())
    sha.update(json.dumps(dict(scene.provenance), sort_keys=True).encode())
    return sha.hexdigest()


def _digests(order: list[int], seed: int) -> dict[int, str]:
    pool = small_pool()
    return {
        index: digest(first_scene(SETTINGS, pool, seed=seed, scene_index=index)) for index in order
    }


def _points(scene: Scene, row: int) -> NDArray[np.float64]:
    """The distinct vertices of one object."""
    used = scene.faces[scene.object_index == row].ravel()
    return np.unique(scene.vertex_positions[used], axis=0).astype(np.float64)


def _planes(scene: Scene) -> NDArray[np.float64]:
    """[K, 4] inward plane of each shell part."""
    rows = []
    for row, entry in enumerate(scene.objects):
        if entry.kind == "shell":
            vertex = scene.faces[scene.object_index == row][0, 0]
            normal = scene.vertex_normals[vertex].astype(np.float64)
            rows.append(np.append(normal, -normal @ scene.vertex_positions[vertex]))
    return np.array(rows)


def test_order_does_not_matter_and_seed_zero_is_a_seed() -> None:
    forward = _digests([0, 1, 2, 3, 4, 5], seed=0)
    assert forward == _digests([5, 3, 1, 4, 2, 0], seed=0)
    other = _digests([0, 1, 2, 3, 4, 5], seed=1)
    assert len({*forward.values(), *other.values()}) == 12


def test_attempts_differ_but_keep_template_and_number_of_objects(pool: list[PooledAsset]) -> None:
    for index in range(5):
        tries = []
        for attempt in range(4):
            with contextlib.suppress(Rejected):
                scene = compose_scene(SETTINGS, pool, seed=0, scene_index=index, attempt=attempt)
                tries.append(scene)
        assert len({digest(scene) for scene in tries}) == len(tries) >= 2
        kinds = {
            (scene.provenance["template"], sum(entry.kind == "object" for entry in scene.objects))
            for scene in tries
        }
        assert len(kinds) == 1


def test_the_number_of_processors_and_threads_does_not_matter() -> None:
    """The same bytes from another process that is held to one processor and one thread."""
    code = (
        "import os; os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])\n"
        "from tests.scenes.test_compose import _digests\n"
        "print(*_digests(list(range(8)), seed=5).values())"
    )
    one_thread = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    made = subprocess.run(
        [sys.executable, "-c", code],
        cwd=Path(__file__).parents[2],
        env=one_thread,
        capture_output=True,
        text=True,
        check=True,
    )
    assert made.stdout.split() == list(_digests(list(range(8)), seed=5).values())


@pytest.mark.parametrize("max_triangles", [523, 700, 1536, 4096])
def test_the_budget_is_never_exceeded(pool: list[PooledAsset], max_triangles: int) -> None:
    settings = SceneSettings(max_triangles=max_triangles, num_views=1)
    counts = []
    for index in range(60):
        try:
            scene = compose_scene(settings, pool, seed=1, scene_index=index, attempt=0)
        except Rejected as rejected:
            assert rejected.reason == "over_budget"
            continue
        counts.append(scene.num_triangles)
        # A refined budget leaves no shell or emitter out.
        shell = SHELL_TRIANGLES[scene.provenance["template"]]
        kinds = np.array([entry.kind for entry in scene.objects])[scene.object_index]
        assert (kinds == "shell").sum() == shell
        assert (kinds == "object").any()
    assert max(counts) <= max_triangles
    assert len(counts) >= 10


def test_every_scene_keeps_the_laws_of_the_record(scenes: list[Scene]) -> None:
    for scene in scenes:
        scene.check()
        assert scene.num_views == SETTINGS.num_views
        assert scene.num_triangles <= SETTINGS.max_triangles
        assert json.loads(json.dumps(dict(scene.provenance))) == scene.provenance
        assert {"template", "scene_index", "attempt", "seed", "camera_attempts"} == set(
            scene.provenance
        )


def test_templates_and_object_counts_have_even_shares(scenes: list[Scene]) -> None:
    templates = [scene.provenance["template"] for scene in scenes]
    counts = [sum(entry.kind == "object" for entry in scene.objects) for scene in scenes]
    # Five standard deviations of a share of 1/4 or 1/3 among 200.
    for name in SHELL_TRIANGLES:
        assert abs(templates.count(name) / 200 - 1 / 4) < 5 * np.sqrt(3 / 16 / 200)
    for count in (1, 2, 3):
        assert abs(counts.count(count) / 200 - 1 / 3) < 5 * np.sqrt(2 / 9 / 200)


def test_emitters_add_up_and_have_rows_of_their_own(scenes: list[Scene]) -> None:
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


def test_emitters_are_outside_of_all_geometry(scenes: list[Scene]) -> None:
    for scene in scenes:
        emits = scene.triangle_emits
        solid = np.linalg.norm(scene.vertex_positions[scene.faces[~emits].ravel()], axis=1)
        lights = np.linalg.norm(scene.vertex_positions[scene.faces[emits].ravel()], axis=1)
        assert lights.min() > solid.max()


def test_objects_stay_in_the_room(scenes: list[Scene]) -> None:
    for scene in scenes:
        planes = _planes(scene)
        for row, entry in enumerate(scene.objects):
            if entry.kind == "object":
                points = _points(scene, row)
                heights = points @ planes[:, :3].T + planes[:, 3]
                assert heights.min() > -TOUCH
                assert np.abs(points).max() < 1.2  # beside the room by half a radius at most


def test_about_half_of_the_objects_touch_the_floor(scenes: list[Scene]) -> None:
    touches = []
    for scene in scenes:
        floor = _planes(scene)[0]
        for row, entry in enumerate(scene.objects):
            if entry.kind == "object":
                touches.append((_points(scene, row) @ floor[:3] + floor[3]).min() < TOUCH)
    # 400 objects: a standard deviation of 0.025, and what the way down costs (test_layouts).
    assert 0.4 < np.mean(touches) < 0.6


def test_spheres_around_the_vertex_means_do_not_meet(scenes: list[Scene]) -> None:
    for scene in scenes:
        spheres: list[tuple[NDArray[np.float64], float]] = []
        for row, entry in enumerate(scene.objects):
            if entry.kind == "object":
                points = _points(scene, row)
                centre = points.mean(axis=0)
                spheres.append((centre, float(np.linalg.norm(points - centre, axis=1).max())))
        for row, (centre, radius) in enumerate(spheres):
            for other, reach in spheres[:row]:
                assert np.linalg.norm(centre - other) > radius + reach - TOUCH


def test_shading_normals_face_the_side_of_their_triangle(scenes: list[Scene]) -> None:
    for scene in scenes:
        corners = scene.vertex_positions[scene.faces].astype(np.float64)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        geometric = cross / np.linalg.norm(cross, axis=1, keepdims=True)
        facing = np.einsum("tci,ti->tc", scene.vertex_normals[scene.faces], geometric)
        assert facing.min() > 0.1 - 1e-6  # shading.LEAST_FACING, less float32 rounding


def test_rights_travel_and_names_are_unique(pool: list[PooledAsset]) -> None:
    wall = [entry for entry in pool if entry.locked.uid == "made/wall1"]
    settings = SceneSettings(templates=("corner",), num_objects=(3, 3), num_views=1)
    scene = compose_scene(settings, wall, seed=0, scene_index=0, attempt=0)
    objects = [entry for entry in scene.objects if entry.kind == "object"]
    assert [entry.name for entry in objects] == ["wall1_2", "wall1_3", "wall1_4"]
    for entry in objects:
        assert entry.uid == "made/wall1"
        assert entry.licence == "CC0-1.0"
        assert entry.attribution == "maker of made/wall1"
        assert entry.source_url == "https://example.org/made/wall1"


def test_an_empty_pool_is_a_users_mistake() -> None:
    with pytest.raises(TrilightError, match="pool"):
        compose_scene(SETTINGS, [], seed=0, scene_index=0, attempt=0)


def test_an_object_that_is_too_large_is_rejected(pool: list[PooledAsset]) -> None:
    settings = SceneSettings(templates=("plane",), max_triangles=139)
    with pytest.raises(Rejected) as caught:
        compose_scene(settings, pool, seed=0, scene_index=0, attempt=0)
    assert caught.value.reason == "over_budget"


def test_a_mesh_without_usable_triangles_is_rejected(pool: list[PooledAsset]) -> None:
    broken = pooled("made/nan", [])
    mesh = pool[1].asset.levels[0]
    positions = mesh.positions.copy()
    positions[0] = np.nan
    levels = (type(mesh)(record=mesh.record, positions=positions, faces=mesh.faces),)
    asset = dataclasses.replace(broken.asset, levels=levels)
    pool = [PooledAsset(locked=broken.locked, asset=asset)]
    with pytest.raises(Rejected) as caught:
        compose_scene(SETTINGS, pool, seed=0, scene_index=0, attempt=0)
    assert caught.value.reason == "no_faces"


def test_real_objects_compose(real_pool: list[PooledAsset]) -> None:
    """Thin, open, doubled and many-part meshes as people publish them keep every law."""
    for index in range(40):
        scene = first_scene(SETTINGS, real_pool, seed=0, scene_index=index)
        scene.check()
        assert scene.num_triangles <= SETTINGS.max_triangles
