"""Numerical extremes of meshes: the size of the world, slivers, plates, edges of budgets."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.assets.mesh import TriangleMesh
from pipeline.assets.settings import AssetSettings
from storage.records.asset import Asset
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


def check(asset: Asset, settings: AssetSettings) -> None:
    for level in asset.levels:
        assert 1 <= len(level.faces) <= level.record.budget
        assert np.isfinite(level.positions).all()
        assert level.record.quality.error_p99 <= settings.gate.max_error_p99


def test_the_size_of_the_world_changes_nothing(tmp_path: Path) -> None:
    unit = moved(knot(), 1 / np.ptp(knot().positions, axis=0).max())
    settings = AssetSettings(budgets=(500,))
    plain = prepare(write_off(tmp_path / "b.off", unit), settings)
    for extent in (1e-8, 1e8):
        scaled = prepare(write_off(tmp_path / "a.off", moved(unit, extent)), settings)
        assert geometry(scaled) == geometry(plain), extent


def test_beyond_them_it_ends(tmp_path: Path) -> None:
    unit = moved(knot(), 1 / np.ptp(knot().positions, axis=0).max())
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


def tetrahedron() -> TriangleMesh:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    return TriangleMesh(positions=corners, faces=faces)


@pytest.mark.parametrize("flip", [False, True])
def test_four_faces_are_enough(tmp_path: Path, flip: bool) -> None:
    solid = tetrahedron()
    mesh = TriangleMesh(positions=solid.positions, faces=solid.faces[:, :: -1 if flip else 1])
    asset = prepare(write_off(tmp_path / "a.off", mesh), AssetSettings(budgets=(4,)))
    (level,) = asset.levels
    corners = level.positions.astype(np.float64)[level.faces]
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert (len(level.faces), asset.source.num_parts, asset.source.watertight) == (4, 1, True)
    assert volume == pytest.approx(1 / 6, rel=1e-5)  # float32 positions


def test_one_triangle_is_an_object(tmp_path: Path) -> None:
    one = TriangleMesh(positions=np.eye(3), faces=np.array([[0, 1, 2]]))
    settings = AssetSettings()
    asset = prepare(write_off(tmp_path / "a.off", one), settings)
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


def test_a_limit_of_faces_is_a_limit(tmp_path: Path) -> None:
    path = write_off(tmp_path / "a.off", cube(4))
    faces = len(cube(4).faces)
    assert prepare(path, AssetSettings(max_source_faces=faces)).levels
    assert reason_of(path, AssetSettings(max_source_faces=faces - 1)) == "too_many_faces"
