"""Far from the defaults, scenes keep every law; the ends of settings are in test_range_ends.

And numerical extremes of their meshes: the size of the world, slivers, plates, edges of budgets.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.assets.settings import AssetSettings
from pipeline.foreign.mesh import TriangleMesh
from pipeline.presets.registry import DATASET_PRESETS, preset_settings
from pipeline.scenes.triangle_budget import PooledAsset
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.settings import SceneSettings
from storage.records.asset import Asset
from storage.records.scene import Scene
from storage.settings.overrides import apply_overrides
from tests.for_each import case, for_each
from tests.pipeline.assets.meshes_by_hand import (
    cube,
    geometry,
    knot,
    moved,
    prepare,
    reason_of,
    sphere,
    write_obj,
    write_off,
)
from tests.pipeline.scenes.small_pool import counts_of, digest, first_scene, rows_of

SETTINGS = SceneSettings(families=DEFAULT_FAMILIES)


def require_laws(scene: Scene, settings: SceneSettings) -> None:
    """Require the laws of the record, and the numbers that settings state."""
    scene.check()
    assert scene.num_views == settings.num_views
    assert scene.num_triangles <= settings.max_triangles
    counts = counts_of(scene)
    assert counts["shell"] % 128 == 0
    assert settings.lights.count[0] <= counts["emitter"] <= settings.lights.count[1]


LAST = 999_999_998
FAR = [(0, LAST), (2**63, LAST), (2**64 + 1, 30), (2**200, 10**9 + 7)]
"""Seeds and indices."""


def test_far_seeds_and_indices_are_seeds_and_indices_of_their_own(pool: list[PooledAsset]) -> None:
    """Beyond 32 and 64 bits; a sample's name holds indices of nine digits."""
    for number, build in enumerate(DATASET_PRESETS):
        settings = preset_settings(build, changes={"scenes.num_views": 1}).scenes
        seed, index = FAR[number % len(FAR)]
        with case((build, f"{seed}", f"{index}")):
            scene = first_scene(settings, pool, seed=seed, scene_index=index)
            require_laws(scene, settings.of_scene(index))
            assert scene.provenance["scene_index"] == index
    settings = preset_settings("pretrain-256", changes={"scenes.num_views": 1}).scenes
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


@for_each(
    "changes",
    [
        {},
        {"placement.overlap_share": 1.0},
        {"families.smooth_share": 1.0, "materials.coloured_share": 1.0},
        {"fill_to": 1536},
    ],
)
def test_objects_of_one_triangle_compose(
    pool: list[PooledAsset], changes: Mapping[str, Any]
) -> None:
    settings = apply_overrides(SETTINGS, {"views.min_coverage": 0.0, **changes})
    for index in range(3):
        scene = first_scene(settings, [_one_triangle(pool)], seed=0, scene_index=index)
        require_laws(scene, settings)
        objects = len(rows_of(scene, "object"))
        if settings.fill_to is None:
            assert counts_of(scene)["object"] == objects
        else:
            assert scene.num_triangles > 1536 - 3 * objects


@pytest.mark.parametrize("build", ["pretrain-256", "out-of-range"])
def test_a_pool_of_one_object_fills_every_scene(pool: list[PooledAsset], build: str) -> None:
    settings = preset_settings(build, changes={"scenes.num_views": 1}).scenes
    for entry in (pool[1], pool[4]):
        for index in range(30, 32):
            scene = first_scene(settings, [entry], seed=0, scene_index=index)
            require_laws(scene, settings.of_scene(index))
            uids = {scene.objects[row].uid for row in rows_of(scene, "object")}
            assert uids <= {entry.locked.uid}
            names = [entry.name for entry in scene.objects]
            assert len(set(names)) == len(names)


def check(asset: Asset, settings: AssetSettings) -> None:
    for level in asset.levels:
        assert 1 <= len(level.faces) <= level.record.budget
        assert np.isfinite(level.positions).all()
        assert level.record.quality.error_p99 <= settings.gate.max_error_p99


def test_the_size_of_the_world_changes_nothing_up_to_its_limits(tmp_path: Path) -> None:
    unit = moved(knot(), 1 / np.ptp(knot().positions, axis=0).max())
    settings = AssetSettings(budgets=(500,))
    plain = prepare(write_off(tmp_path / "b.off", unit), settings)
    for extent in (1e-8, 1e8):
        scaled = prepare(write_off(tmp_path / "a.off", moved(unit, extent)), settings)
        assert geometry(scaled) == geometry(plain), extent
    for extent in (0.9e-9, 1.1e9):
        path = write_off(tmp_path / "a.off", moved(unit, extent))
        assert reason_of(path) == "extent_range", extent


@pytest.mark.parametrize("method", ["pymeshlab_collapse", "meshoptimizer"])
def test_slivers_of_a_million_to_one(tmp_path: Path, method: str) -> None:
    """A cylinder of 3000 strips as long as the box, each 1e-6 of it apart at the ends."""
    turn = np.linspace(0, 2 * np.pi, 1501)[:-1]
    rim = np.column_stack([np.cos(turn), np.sin(turn)]) * 2.4e-4
    ends = [np.column_stack([rim, np.full(1500, z)]) for z in (-0.5, 0.5)]
    here, there = np.arange(1500), (np.arange(1500) + 1) % 1500
    lower = np.column_stack([here, there, here + 1500])
    upper = np.column_stack([there, there + 1500, here + 1500])
    faces = np.concatenate([lower, upper])
    pole = TriangleMesh(positions=np.concatenate(ends), faces=faces)
    settings = AssetSettings(budgets=(1400,))
    asset = prepare(write_obj(tmp_path / "a.obj", pole), settings, method)
    check(asset, settings)
    assert asset.levels


def test_a_plate_a_hundred_thousandth_thick(tmp_path: Path) -> None:
    """Ten cells of the grid: its two sides stay apart, and each faces its own way."""
    plate = moved(cube(10), [1.0, 1.0, 1e-5])
    settings = AssetSettings(budgets=(1200, 500))
    asset = prepare(write_obj(tmp_path / "a.obj", plate), settings)
    check(asset, settings)
    finest = asset.levels[0]
    assert len(finest.faces) == 1200
    assert asset.source.watertight
    assert asset.source.front_share == 1.0
    # Half of 1e-5 to either side, on a grid of 2^-20.
    np.testing.assert_allclose(np.abs(finest.positions[:, 2]).max(), 5e-6, atol=2**-21)


@pytest.mark.parametrize("flip", [False, True])
def test_four_faces_are_enough(tmp_path: Path, flip: bool) -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    mesh = TriangleMesh(positions=corners, faces=faces[:, :: -1 if flip else 1])
    asset = prepare(write_off(tmp_path / "a.off", mesh), AssetSettings(budgets=(4,)))
    (level,) = asset.levels
    corners = level.positions.astype(np.float64)[level.faces]
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert (len(level.faces), asset.source.num_parts, asset.source.watertight) == (4, 1, True)
    assert volume == pytest.approx(1 / 6, rel=1e-5)  # float32 positions


def test_one_triangle_is_an_object(tmp_path: Path) -> None:
    one = TriangleMesh(positions=np.eye(3), faces=np.array([[0, 1, 2]]))
    asset = prepare(write_off(tmp_path / "a.off", one), AssetSettings())
    (level,) = asset.levels
    assert (len(level.faces), level.record.method) == (1, "source")
    assert asset.source.open_edges == 3


@pytest.mark.parametrize(
    ("method", "rings"),
    [
        pytest.param("pymeshlab_collapse", 251, marks=pytest.mark.slow("memory")),
        ("meshoptimizer", 51),
    ],
)
def test_as_many_faces_as_scans_have(tmp_path: Path, method: str, rings: int) -> None:
    ball = sphere(rings=rings, columns=400)
    assert len(ball.faces) == 800 * rings
    settings = AssetSettings(budgets=(1400,))
    asset = prepare(write_off(tmp_path / "a.off", ball), settings, method)
    check(asset, settings)
    # 1400 triangles of a ball leave chords of 0.1 % of its diagonal; five times that is a hole
    assert asset.levels[0].record.quality.error_p99 < 0.005


@pytest.mark.parametrize("spare", [0, -1, 1])
def test_a_source_at_the_edge_of_its_budget(tmp_path: Path, spare: int) -> None:
    mesh = cube(10)
    budget = len(mesh.faces) + spare
    asset = prepare(write_obj(tmp_path / "a.obj", mesh), AssetSettings(budgets=(budget,)))
    (level,) = asset.levels
    assert (level.record.method == "source") == (spare >= 0)
    assert len(level.faces) == len(mesh.faces) if spare >= 0 else len(level.faces) <= budget
