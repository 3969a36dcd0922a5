"""Files and meshes that crash, hang or lead out: an asset or a reason, and no other file."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.assets.settings import AssetSettings
from pipeline.assets.stage import prepare_assets
from pipeline.assets.store import AssetStore
from pipeline.foreign.mesh import TriangleMesh
from pipeline.generation.prepare_isolated import asset_child
from pipeline.isolation import IsolatedChild
from storage.records.asset import Asset, decode_asset
from tests.conftest import ROOT
from tests.pipeline.assets import meshes_by_hand as by_hand
from tests.pipeline.assets.meshes_by_hand import prepare

WATCH = """
import json, sys
from pathlib import Path
from pipeline.assets.settings import AssetSettings
from tests.pipeline.assets.meshes_by_hand import prepare
import pipeline.assets.decimation.pymeshlab_filters
opened = []
def note(event, args):
    if event == "open":
        opened.append(str(args[0]))
    if event.startswith(("socket.", "subprocess.", "os.exec", "os.system")):
        opened.append(event)
sys.addaudithook(note)
for path in sys.argv[1:]:
    opened.clear()
    prepare(Path(path))
    print(json.dumps(opened))
"""


def opened_for(*paths: Path) -> list[list[str]]:
    """Files and sockets that a fresh process opens while it prepares each, by audit hook."""
    result = subprocess.run(
        [sys.executable, "-c", WATCH, *map(str, paths)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return [json.loads(line) for line in result.stdout.splitlines()[-len(paths) :]]


def test_an_obj_opens_no_material_and_a_gltf_its_buffers_and_no_picture(tmp_path: Path) -> None:
    material, tree = obj_with_material(tmp_path), gltf_with_pictures(tmp_path)
    assert opened_for(material, tree) == [[str(material)], [str(tree), str(tmp_path / "a.bin")]]


def obj_with_material(tmp_path: Path) -> Path:
    (tmp_path / "secret.mtl").write_text("newmtl a\nmap_Kd ../../../../../etc/hostname\n")
    folder = tmp_path / "objects"
    folder.mkdir()
    path = by_hand.write_obj(folder / "a.obj", by_hand.knot(segments=80))
    text = "mtllib ../secret.mtl\nmtllib /etc/hostname\nusemtl a\n" + path.read_text()
    path.write_text(text)
    return path


def gltf_with_pictures(tmp_path: Path) -> Path:
    tree, buffer = by_hand.gltf_tree(by_hand.sphere())
    tree["buffers"][0]["uri"] = "a.bin"
    tree["images"] = [{"uri": "../../etc/hostname"}, {"uri": "http://127.0.0.1:1/a.png"}]
    tree["textures"] = [{"source": 0}, {"source": 1}]
    tree["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    tree["meshes"][0]["primitives"][0]["material"] = 0
    (tmp_path / "a.bin").write_bytes(buffer)
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(tree))
    return path


def test_odd_names_are_names(tmp_path: Path) -> None:
    for name in (b"line\nbreak.obj", b"not-utf8-\xff\xfe.obj", b"'; --.obj"):
        path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name))
        by_hand.write_obj(path, by_hand.sphere(rings=5, columns=8))
        assert prepare(path).levels, name


def test_the_second_method_serves_where_the_first_died(tmp_path: Path) -> None:
    path = by_hand.write_obj(tmp_path / "knot.obj", by_hand.knot())
    asset = prepare(path, AssetSettings(), "meshoptimizer_sloppy")
    assert {level.record.method for level in asset.levels} == {"meshoptimizer_sloppy"}
    for level in asset.levels:
        assert len(level.faces) <= level.record.budget
        assert level.record.quality.error_p99 <= AssetSettings().gate.max_error_p99


Outcome = Callable[..., tuple[Asset | None, str]]


@pytest.fixture(scope="module")
def child() -> Iterator[IsolatedChild]:
    child = asset_child()
    yield child
    child.close()


@pytest.fixture
def outcome(child: IsolatedChild, tmp_path: Path) -> Outcome:
    """The asset of a mesh in a file, or the reason for having none."""

    def prepare(
        mesh: TriangleMesh, settings: AssetSettings | None = None, suffix: str = ".obj"
    ) -> tuple[Asset | None, str]:
        path = by_hand.WRITERS[suffix](tmp_path / f"a{suffix}", mesh)
        prepared, failures = prepare_assets(
            [by_hand.record_of(path)],
            settings or AssetSettings(),
            AssetStore(tmp_path / "store"),
            borrow_child=lambda: nullcontext(child),
            workers=1,
            done=lambda: None,
        )
        if failures:
            return None, failures[0].reason
        path = AssetStore(tmp_path / "store").asset_path(prepared[0].asset_name)
        return decode_asset(path.read_bytes()), ""

    return prepare


def check(asset: Asset | None) -> Asset:
    """Whatever came in, what goes out keeps the laws of levels."""
    assert asset is not None
    sizes = [len(level.faces) for level in asset.levels]
    assert sizes == sorted(set(sizes), reverse=True)
    for level in asset.levels:
        assert 1 <= len(level.faces) <= level.record.budget
        assert np.isfinite(level.positions).all()
        assert level.faces.max() < len(level.positions)
    return asset


def polygon(corners: int) -> TriangleMesh:
    """One face with that many corners, as loaders split it: a fan around the first."""
    turn = 2 * np.pi * np.arange(corners) / corners
    rim = np.column_stack([np.cos(turn), np.sin(turn), 0.1 * np.cos(3 * turn)])
    spokes = np.arange(1, corners - 1)
    faces = np.column_stack([np.zeros_like(spokes), spokes, spokes + 1])
    return TriangleMesh(positions=rim, faces=faces)


def book(pages: int) -> TriangleMesh:
    """Faces that all share one edge."""
    page = np.arange(2, pages + 2)
    return TriangleMesh(
        positions=np.random.default_rng(0).random((pages + 2, 3)),
        faces=np.column_stack([np.zeros_like(page), np.ones_like(page), page]),
    )


def soup(faces: int) -> TriangleMesh:
    rng = np.random.default_rng(0)
    return TriangleMesh(positions=rng.random((400, 3)), faces=rng.integers(0, 400, (faces, 3)))


def boxes(count: int) -> TriangleMesh:
    places = np.random.default_rng(0).random((count, 3)) * 50
    return by_hand.joined(*(by_hand.moved(by_hand.cube(), 1.0, place) for place in places))


def with_repeated_corners(mesh: TriangleMesh) -> TriangleMesh:
    doubled = mesh.faces[::3, [0, 1, 1]]
    return TriangleMesh(positions=mesh.positions, faces=np.concatenate([mesh.faces, doubled]))


def test_faces_with_repeated_corners_are_dropped(outcome: Outcome) -> None:
    settings = AssetSettings(budgets=(500,))
    dirty, _ = outcome(with_repeated_corners(by_hand.knot(80)), settings)
    tidy, _ = outcome(by_hand.knot(80), settings)
    assert check(dirty).geometry_sha256 == check(tidy).geometry_sha256
    assert dirty is not None and dirty.source.repaired
    assert tidy is not None and not tidy.source.repaired
    assert dirty.source.num_faces_read == 1920 + 640


def test_both_sides_of_every_face_count_once(outcome: Outcome) -> None:
    one = by_hand.knot(80)
    both = by_hand.joined(one, TriangleMesh(positions=one.positions, faces=one.faces[:, ::-1]))
    asset, _ = outcome(both, AssetSettings(budgets=(500,)))
    assert check(asset).source.num_faces == 1920
    assert asset is not None and asset.source.watertight


@pytest.mark.parametrize("pages", [8, 9, 400])
def test_many_faces_on_one_edge_end(outcome: Outcome, pages: int) -> None:
    asset, _ = outcome(book(pages), AssetSettings(budgets=(1400, 340, 240)))
    assert check(asset).levels[0].record.method == "source"
    assert asset is not None and asset.source.nonmanifold_edges == 1
    if pages == 400:
        methods = {level.record.method for level in asset.levels[1:]}
        assert methods <= {"meshoptimizer", "meshoptimizer_sloppy"}


@pytest.mark.parametrize("profile", ["faithful", "uniform"])
def test_a_random_soup_ends_with_a_reason(outcome: Outcome, profile: Any) -> None:
    asset, reason = outcome(soup(1000), AssetSettings(budgets=(500,), profile=profile))
    assert asset is None
    geometric = {"area_changed", "bbox_escaped", "budget_missed", "error_over_bound"}
    assert reason in {*geometric, "crashed_signal_11"}


@pytest.mark.slow("hostile")
@pytest.mark.parametrize("profile", ["faithful", "uniform"])
def test_a_polygon_of_fifty_thousand_corners_ends(outcome: Outcome, profile: Any) -> None:
    """Its hub has a valence of 50 000; the child of a run that used its seconds is killed."""
    asset, reason = outcome(polygon(50_000), AssetSettings(budgets=(1400,), profile=profile))
    assert not reason.startswith(("timeout", "crashed", "killed", "out_of_memory"))
    if asset is not None:
        check(asset)


def test_a_wide_fan_is_kept_from_pymeshlab(outcome: Outcome) -> None:
    asset, reason = outcome(polygon(600), AssetSettings(budgets=(500,)))
    assert reason == ""
    used = {level.record.method for level in check(asset).levels}
    assert used <= {"meshoptimizer", "meshoptimizer_sloppy"}


@pytest.mark.parametrize("count", [50, pytest.param(5000, marks=pytest.mark.slow("hostile"))])
def test_many_boxes_do_not_fit_into_240_triangles(outcome: Outcome, count: int) -> None:
    asset, reason = outcome(boxes(count), AssetSettings(budgets=(240,)))
    assert asset is None
    assert reason in {"area_changed", "error_over_bound", "parts_lost", "budget_missed"}


def test_a_floor_of_two_triangles_is_an_object(outcome: Outcome) -> None:
    corners = np.array([[0, 0, 0], [4, 0, 0], [4, 3, 0], [0, 3, 0]], float)
    floor = TriangleMesh(positions=corners, faces=np.array([[0, 1, 2], [0, 2, 3]]))
    for profile in ("faithful", "uniform"):
        asset, _ = outcome(floor, AssetSettings(profile=profile), ".off")
        assert check(asset).source.num_parts == 1
        assert asset is not None and asset.source.front_share == pytest.approx(0.5, abs=0.2)


def test_sizes_that_are_no_sizes(outcome: Outcome) -> None:
    for scale in (1e-200, 1e-10, 1e10, 1e200):
        mesh = by_hand.moved(by_hand.sphere(), scale)
        assert outcome(mesh)[1] == "extent_range", scale


@pytest.mark.parametrize(
    ("suffix", "reason"), [(".stl", "offset_precision"), (".ply", ""), (".obj", "")]
)
def test_an_object_far_from_its_origin(outcome: Outcome, suffix: str, reason: str) -> None:
    """An offset of 1e6 extents is refused in single precision; doubles and text are exact."""
    asset, found = outcome(by_hand.moved(by_hand.sphere(), 1.0, 1e6), suffix=suffix)
    assert found == reason
    assert (asset is None) == bool(reason)


def test_a_vertex_ten_thousand_extents_away(outcome: Outcome) -> None:
    ball = by_hand.sphere()
    far = np.concatenate([ball.positions, [[1e4, 0, 0], [1e4, 1e-3, 0], [1e4, 0, 1e-3]]])
    count = len(ball.positions)
    speck = np.array([[count, count + 1, count + 2]])
    mesh = TriangleMesh(positions=far, faces=np.concatenate([ball.faces, speck]))
    assert outcome(mesh)[1] in {"far_outlier", "degenerate"}
