"""From a file to an asset: the laws that hold whatever the file says."""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.assets.cleaning.orient import orient_outward
from pipeline.assets.mesh import TriangleMesh
from pipeline.assets.quality.distance import Surface
from pipeline.assets.reading.load import load_mesh
from pipeline.assets.reading.source_file import read_source
from pipeline.assets.settings import AssetSettings, GateSettings
from storage.errors import TrilightError
from storage.records.asset import Asset, decode_asset, encode_asset
from tests.conftest import ROOT
from tests.pipeline.assets.meshes_by_hand import (
    WRITERS,
    cleaned,
    flip_some,
    geometry,
    gltf_tree,
    knot,
    mesh_of,
    prepare,
    sphere,
    volume,
    write_glb,
    write_obj,
)

SETTINGS = AssetSettings()


def small_knot() -> TriangleMesh:
    return knot(segments=80)


@pytest.fixture(scope="module")
def asset(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    """A knot of 1920 faces: every level needs decimation."""
    return prepare(write_obj(tmp_path_factory.mktemp("knot") / "knot.obj", small_knot()))


def test_every_budget_is_kept_and_used(asset: Asset) -> None:
    assert [level.record.budget for level in asset.levels] == list(SETTINGS.budgets)
    for level in asset.levels:
        # pymeshlab collapses edges, which take two faces each: it stops at most one short.
        assert level.record.budget - 1 <= len(level.faces) <= level.record.budget
        assert level.faces.max() < len(level.positions)
        assert np.isfinite(level.positions).all()
        assert np.abs(level.positions).max() <= 0.5 + 0.01 * np.sqrt(3)


def test_the_error_holds_on_other_points(asset: Asset) -> None:
    source, _ = orient_outward(cleaned(small_knot()))
    surface = Surface(source, np.random.default_rng(99).random((8192, 3)))
    for level in asset.levels:
        assert level.record.quality.error_p99 <= SETTINGS.gate.max_error_p99
        deviation = surface.deviation(mesh_of(level))
        for way in (deviation.there, deviation.back):
            # The recorded percentile comes from 8192 points: its rank is known to 0.33 % (3 sigma).
            assert np.percentile(way, 98.6) <= level.record.quality.error_p99


def test_a_source_within_budget_is_kept_once_as_it_is(tmp_path: Path) -> None:
    mesh = sphere(rings=13, columns=24)
    asset = prepare(write_obj(tmp_path / "a.obj", mesh))
    budgets = [level.record.budget for level in asset.levels]
    assert (len(mesh.faces), budgets) == (624, [1400, 500, 340, 240])
    first = asset.levels[0]
    assert first.record.method == "source"
    # Points are interpolated and projected in double precision, on a surface of size 1.
    assert first.record.quality.error_max < 1e-14
    assert len(first.faces) == 624


def test_scale_and_place_of_the_source_change_nothing(tmp_path: Path, asset: Asset) -> None:
    mesh = small_knot()
    moved = TriangleMesh(positions=mesh.positions * 0.001 + [5, -3, 2], faces=mesh.faces)
    again = prepare(write_obj(tmp_path / "moved.obj", moved))
    assert geometry(again) == geometry(asset)
    assert again.geometry_sha256 == asset.geometry_sha256


def test_a_quarter_turn_of_the_source_keeps_numbers_and_errors(
    tmp_path: Path, asset: Asset
) -> None:
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = TriangleMesh(positions=small_knot().positions @ turn.T, faces=small_knot().faces)
    again = prepare(write_obj(tmp_path / "turned.obj", turned))
    for here, there in zip(asset.levels, again.levels, strict=True):
        assert abs(len(here.faces) - len(there.faces)) <= 1
        # Edges of equal cost collapse in another order: other triangles, an error of the same size.
        error = here.record.quality.error_p99
        assert there.record.quality.error_p99 == pytest.approx(error, rel=0.2)


def test_flipped_faces_change_nothing(tmp_path: Path, asset: Asset) -> None:
    """Every patch is turned outward first, so decimation sees the same mesh."""
    flipped = flip_some(small_knot(), 0.3, np.random.default_rng(5))
    again = prepare(write_obj(tmp_path / "flipped.obj", flipped))
    assert geometry(again) == geometry(asset)
    assert again.geometry_sha256 == asset.geometry_sha256


def test_formats_agree(tmp_path: Path) -> None:
    """The same single precision numbers in six formats give the same asset."""
    mesh = knot(segments=40)
    single = TriangleMesh(
        positions=mesh.positions.astype(np.float32).astype(np.float64), faces=mesh.faces
    )
    paths = [write(tmp_path / f"a{suffix}", single) for suffix, write in WRITERS.items()]
    tree, buffer = gltf_tree(single)
    paths.append(write_glb(tmp_path / "a.glb", tree, buffer))
    assets = [prepare(path, AssetSettings(budgets=(500,))) for path in paths]
    assert len({asset.geometry_sha256 for asset in assets}) == 1
    assert len({geometry(asset) for asset in assets}) == 1
    assert len({asset.source_sha256 for asset in assets}) == len(assets)


def test_nodes_place_meshes_where_they_say(tmp_path: Path) -> None:
    tree, buffer = gltf_tree(sphere(rings=5, columns=8))
    tree["nodes"] = [
        {"children": [1, 2], "scale": [2, 2, 2]},
        {"mesh": 0, "translation": [10, 0, 0]},
        {"mesh": 0, "translation": [-10, 0, 0], "scale": [-1, 1, 1]},
    ]
    source = read_source(write_glb(tmp_path / "two.glb", tree, buffer), SETTINGS)
    mesh = load_mesh(source)
    assert len(mesh.faces) == 2 * 80
    # 2 x (10 + 1) to either side; the numbers of the file are single precision.
    np.testing.assert_allclose(np.ptp(mesh.positions[:, 0]), 44, rtol=1e-6)
    assert volume(mesh) == pytest.approx(2 * 8 * volume(sphere(rings=5, columns=8)), rel=1e-5)


def test_buffers_beside_a_gltf_are_read_and_counted(tmp_path: Path) -> None:
    tree, buffer = gltf_tree(sphere())
    tree["buffers"][0]["uri"] = "data/sphere%20one.bin"
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "sphere one.bin").write_bytes(buffer)
    path = tmp_path / "sphere.gltf"
    path.write_text(json.dumps(tree))
    before = prepare(path)
    assert (
        before.geometry_sha256
        == prepare(write_obj(tmp_path / "s.obj", _single(sphere()))).geometry_sha256
    )
    changed = bytearray(buffer)
    changed[0] ^= 1
    (tmp_path / "data" / "sphere one.bin").write_bytes(bytes(changed))
    assert prepare(path).source_sha256 != before.source_sha256


def _single(mesh: TriangleMesh) -> TriangleMesh:
    return TriangleMesh(
        positions=mesh.positions.astype(np.float32).astype(np.float64), faces=mesh.faces
    )


def test_assets_survive_the_disk(asset: Asset) -> None:
    assert geometry(decode_asset(encode_asset(asset))) == geometry(asset)


def test_two_processes_write_the_same_bytes(tmp_path: Path, asset: Asset) -> None:
    path = write_obj(tmp_path / "knot.obj", small_knot())
    code = (
        "import hashlib, sys; from storage.records.asset import encode_asset;"
        "from tests.pipeline.assets.meshes_by_hand import prepare; from pathlib import Path;"
        "asset = prepare(Path(sys.argv[1]));"
        "print(hashlib.sha256(encode_asset(asset)).hexdigest())"
    )
    one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    result = subprocess.run(
        [sys.executable, "-c", code, str(path)],
        cwd=ROOT,
        env=os.environ | one_thread,
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stdout.strip() == hashlib.sha256(encode_asset(asset)).hexdigest()


NO_SETTINGS: list[dict[str, Any]] = [
    {"budgets": ()},
    {"budgets": (500, 500)},
    {"budgets": (500, 700)},
    {"budgets": (500, 3)},
    {"profile": "fast"},
    {"epsilon": 0.0},
    {"epsilon": 0.04},
    {"epsilon": float("nan")},
    {"max_source_bytes": 0},
    {"max_source_faces": 0},
    {"max_instances": 0},
]
NO_GATES: list[dict[str, Any]] = [
    {"max_error_p99": 0.0},
    {"max_error_p99": 3.0},
    {"max_error_p99": float("nan")},
    {"max_outside": 0.0},
    {"area_ratio": (1.1, 1.2)},
    {"area_ratio": (0.0, 1.2)},
    {"area_ratio": (0.8, 1.0)},
    {"max_normal_error_deg": 91.0},
    {"min_silhouette_iou": 1.1},
    {"max_lost_area": -0.1},
]


def test_settings_without_meaning_are_refused() -> None:
    for kind, wrong in ((AssetSettings, NO_SETTINGS), (GateSettings, NO_GATES)):
        for values in wrong:
            with pytest.raises(TrilightError, match=next(iter(values))):
                kind(**values)


def test_what_the_parent_needs_loads_no_mesh_library() -> None:
    code = (
        "import sys, pipeline.assets.settings, pipeline.assets.recipe, pipeline.assets.stage,"
        "pipeline.assets.store, pipeline.assets.reading.source_file;"
        "print(*sys.modules)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    heavy = {"trimesh", "igl", "pymeshlab", "embreex", "meshoptimizer"}
    assert not heavy & set(result.stdout.split())
