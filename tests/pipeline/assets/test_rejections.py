"""Files that are wrong, crash, hang or lead out: an asset or a reason, and no other file.

Every reason code has a file that earns it.
"""

import gzip
import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.assets.settings import AssetSettings, GateSettings
from pipeline.foreign.mesh import TriangleMesh
from storage.errors import Rejected
from storage.records.asset import Asset
from tests.for_each import for_each
from tests.pipeline.assets import meshes_by_hand as meshes
from tests.pipeline.assets.child_kit import Bench
from tests.pipeline.programs import printed_by

BALL = meshes.sphere(rings=5, columns=8)
NUMBERS: dict[str, tuple[str, TriangleMesh]] = {
    "nan": ("nonfinite_vertices", meshes.with_vertex(BALL, [0, np.nan, 0])),
    "infinity": ("nonfinite_vertices", meshes.with_vertex(BALL, [np.inf, 0, 0])),
    "tiny": ("extent_range", meshes.moved(BALL, 1e-10)),
    "huge": ("extent_range", meshes.moved(BALL, 1e10)),
    "overflowing": ("extent_range", meshes.moved(BALL, 1e308)),
    "point": ("extent_range", meshes.moved(BALL, 0.0, 1.0)),
    "line": ("degenerate", meshes.moved(BALL, [1, 0, 0])),
    "needle": ("degenerate", meshes.moved(BALL, [1, 1e-6, 1e-6])),
    "outlier": (
        "far_outlier",
        meshes.joined(
            meshes.knot(),
            TriangleMesh(positions=np.array([[0, 0, 0], [1e4, 0, 0], [1e4, 1e-3, 0]]),
                         faces=np.array([[0, 1, 2]])),
        ),
    ),
}  # fmt: skip


@for_each("name", NUMBERS)
def test_bad_numbers(tmp_path: Path, name: str) -> None:
    reason, mesh = NUMBERS[name]
    assert meshes.reason_of(meshes.write_off(tmp_path / "a.off", mesh)) == reason


def test_an_offset_is_judged_by_the_precision_of_the_format(tmp_path: Path) -> None:
    far = meshes.moved(BALL, 1.0, 1e6)
    for size in (1.0, 1e-3):  # what counts is how many of its sizes an object is away
        away = meshes.moved(BALL, size, 1e6 * size)
        assert meshes.reason_of(meshes.write_stl(tmp_path / "a.stl", away)) == "offset_precision"
    near = meshes.prepare(meshes.write_obj(tmp_path / "a.obj", BALL))
    exact = meshes.prepare(meshes.write_obj(tmp_path / "b.obj", far))
    # Text keeps 17 digits: at 1e6 the ball is still known to 1e-10, far below the grid of 1e-6.
    assert exact.geometry_sha256 == near.geometry_sha256
    # A vertex without a face may be anything: exporters leave them behind.
    positions = np.concatenate([[[1e30, np.nan, 0]], BALL.positions])
    loose = TriangleMesh(positions=positions, faces=BALL.faces + 1)
    dirty = meshes.write_off(tmp_path / "c.off", loose)
    assert meshes.prepare(dirty).geometry_sha256 == near.geometry_sha256


ARCHIVES = {
    "gzip": gzip.compress(b"v 0 0 0\n" * 100),
    "zip": b"PK\x03\x04" + b"v 0 0 0\n" * 100,
    "tar": b"a.obj".ljust(257, b"\0") + b"ustar\x0000".ljust(767, b"\0"),
}
"""A real one, and the first bytes of others."""


def _ply(header: str, body: bytes = b"") -> bytes:
    return f"ply\nformat binary_little_endian 1.0\n{header}\nend_header\n".encode() + body


_XYZ = "property float x\nproperty float y\nproperty float z"
_LIST = "property list uchar int vertex_indices"

RAW_FILES: dict[str, tuple[str, str, bytes]] = (
    {
        "empty obj": ("no_faces", ".obj", b""),
        "empty stl": ("header_size_mismatch", ".stl", b""),
        "empty ply": ("load_error", ".ply", b""),
        "empty off": ("load_error", ".off", b""),
        "empty glb": ("load_error", ".glb", b""),
        "text in glb": ("load_error", ".glb", b"hello " * 50),
        "text in obj": ("no_faces", ".obj", b"hello " * 50),
        "noise in stl": ("header_size_mismatch", ".stl", bytes(range(256)) * 4),
        "noise in off": ("load_error", ".off", bytes(range(256)) * 4),
        "list in gltf": ("load_error", ".gltf", b"[1, 2]"),
        "number as meshes": ("load_error", ".gltf", b'{"meshes": 7}'),
        "deep json": ("load_error", ".gltf", b'{"a":' + b"[" * 100_000),
        "no scene": ("no_faces", ".gltf", b'{"asset": {"version": "2.0"}}'),
        "stl bomb": ("header_size_mismatch", ".stl", bytes(80) + b"\xff" * 4 + bytes(500)),
        "points": ("point_cloud", ".obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"),
        "obj range": ("index_range", ".obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"),
        "ply range": (
            "index_range",
            ".ply",
            _ply(
                f"element vertex 3\n{_XYZ}\nelement face 1\n{_LIST}",
                np.eye(3, dtype="<f4").tobytes() + struct.pack("<B3i", 3, 0, 1, 77),
            ),
        ),
        "text as archive": ("unsupported_format", ".zip", b"v 0 0 0"),
    }
    | {
        f"{kind} as {suffix}": ("archive_refused", suffix, data)
        for suffix in (".obj", ".glb", ".stl", ".ply") for kind, data in ARCHIVES.items()
    }
    | {
        f"{form} ply bomb {count} {element}": (
            "header_size_mismatch",
            ".ply",
            _ply(f"element {element} {count}\n{_XYZ if element == 'vertex' else _LIST}", body)
            .replace(b"binary_little_endian", form.encode()),
        )
        for form, body, counts in (
            ("binary_little_endian", bytes(64), ()), ("ascii", b"0 0 0\n" * 9, (11,)),
        )
        for count in (*counts, 2**31 - 1, 2**31, 10**18, -5)
        for element in ("vertex", "face")
    }
)  # fmt: skip


@for_each("name", RAW_FILES)
def test_bad_files(tmp_path: Path, name: str) -> None:
    reason, suffix, data = RAW_FILES[name]
    path = tmp_path / f"a{suffix}"
    path.write_bytes(data)
    assert meshes.reason_of(path) == reason


@for_each("write", [meshes.write_stl, meshes.write_ply, meshes.write_off, meshes.write_obj])
def test_limits_of_size(tmp_path: Path, write: Callable[[Path, TriangleMesh], Path]) -> None:
    path = write(tmp_path / f"a.{write.__name__[-3:]}", BALL)
    assert meshes.reason_of(path, AssetSettings(max_source_faces=79)) == "too_many_faces"
    small = AssetSettings(max_source_bytes=path.stat().st_size - 1)
    assert meshes.reason_of(path, small) == "too_large_bytes"


def test_a_header_of_too_many_faces_is_enough(tmp_path: Path) -> None:
    """They are refused before anything is made of them: what follows may be no faces at all."""
    path = meshes.write_ply(tmp_path / "a.ply", BALL)
    header, end, body = path.read_bytes().partition(b"end_header\n")
    path.write_bytes(header + end + b"\xff" * len(body))
    assert meshes.reason_of(path, AssetSettings(max_source_faces=79)) == "too_many_faces"
    assert meshes.reason_of(path, AssetSettings(max_source_faces=80)) != "too_many_faces"


def test_errors_beyond_the_bound_are_stated_and_their_levels_left_out(tmp_path: Path) -> None:
    path = meshes.write_obj(tmp_path / "a.obj", meshes.knot())
    settings = AssetSettings(budgets=(1000,), gate=GateSettings(max_error_p99=1e-4))
    with pytest.raises(Rejected, match=r"error_over_bound: p99 distance \d+\.\d+%"):
        meshes.prepare(path, settings)
    gate = GateSettings(max_error_p99=0.01)
    asset = meshes.prepare(path, AssetSettings(budgets=(1400, 60), gate=gate))
    assert [level.record.budget for level in asset.levels] == [1400]


def test_what_is_no_file_and_odd_names_of_what_is_one(tmp_path: Path) -> None:
    makes: dict[str, Callable[[Path], object]] = {
        "nothing": lambda path: None,
        "folder": Path.mkdir,
        "pipe": os.mkfifo,
        "link to nothing": lambda path: path.symlink_to(tmp_path / "b.obj"),
    }
    for name, make in makes.items():
        make(tmp_path / f"{name}.obj")
        with pytest.raises(Rejected, match=f"^missing_file: .*'{name}.obj'"):
            meshes.prepare(tmp_path / f"{name}.obj")
    for odd in (b"line\nbreak.obj", b"not-utf8-\xff\xfe.obj", b"'; --.obj"):
        path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + odd))
        assert meshes.prepare(meshes.write_obj(path, BALL)).levels, odd


def _add_draco(tree: dict[str, Any], plain: bool = True) -> None:
    """Compressed geometry that readers may ignore where the accessors have plain data as well."""
    extension = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    tree["meshes"][0]["primitives"][0]["extensions"] = extension
    tree["extensionsUsed"] = ["KHR_draco_mesh_compression"]
    if not plain:
        del tree["accessors"][0]["bufferView"]


def _add_targets(
    tree: dict[str, Any], of_mesh: list[float] | None, of_node: list[float] | None
) -> None:
    """Two morph targets that would move every vertex by itself."""
    tree["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": 0}, {"POSITION": 0}]
    if of_mesh is not None:
        tree["meshes"][0]["weights"] = of_mesh
    if of_node is not None:
        tree["nodes"][0]["weights"] = of_node


Change = Callable[[dict[str, Any]], object]


def _requires(extension: str) -> Change:
    return lambda tree: tree.update(extensionsRequired=[extension])


def _node(**fields: Any) -> Change:
    return lambda tree: tree["nodes"][0].update(fields)


def _indices(**fields: Any) -> Change:
    return lambda tree: tree["accessors"][1].update(fields)


TREES: dict[str, tuple[str, Change]] = {
    "own child": ("scene_cycle", _node(children=[0])),
    "cycle": (
        "scene_cycle",
        lambda t: t.update(nodes=[{"mesh": 0, "children": [1]}, {"children": [0]}]),
    ),
    "two parents": (
        "scene_cycle",
        lambda t: t.update(nodes=[{"children": [i + 1, i + 1]} for i in range(24)] + [{"mesh": 0}]),
    ),
    "instances": (
        "too_many_instances",
        lambda t: t.update(nodes=[{"children": list(range(1, 20_001))}] + [{"mesh": 0}] * 20_000),
    ),
    "meshopt": ("compressed_geometry", _requires("EXT_meshopt_compression")),
    "meshopt with a place-holder": (
        "compressed_geometry",
        lambda t: t["buffers"].append(
            {"byteLength": 9999, "extensions": {"EXT_meshopt_compression": {"fallback": True}}}
        ),
    ),
    "draco": ("compressed_geometry", _requires("KHR_draco_mesh_compression")),
    "draco alone": ("compressed_geometry", lambda t: _add_draco(t, plain=False)),
    "unknown extension": ("unsupported_extension", _requires("EXT_something_new")),
    "skin": ("skinned_mesh", _node(skin=0)),
    "weights of no kind": ("load_error", _node(weights=7)),
    "extensions of no kind": ("load_error", lambda t: t["buffers"][0].update(extensions=[1])),
    "all zeros": ("extent_range", lambda t: t["accessors"][0].pop("bufferView")),
    "sparse of no kind": ("load_error", lambda t: t["accessors"][0].update(sparse={"count": 1})),
    "lines": ("no_faces", lambda t: t["meshes"][0]["primitives"][0].update(mode=1)),
    "accessor bomb": ("too_many_faces", _indices(count=2**40)),
    "accessor too long": ("load_error", _indices(count=3000)),
    "indices": ("index_range", lambda t: t["accessors"][0].update(count=20)),
    "no such node": ("load_error", lambda t: t["scenes"][0].update(nodes=[5])),
    "no such mesh": ("load_error", _node(mesh=5)),
    "nan in a transform": ("nonfinite_vertices", _node(translation=[float("nan"), 0, 0])),
    "scaled to nothing": ("extent_range", _node(scale=[0, 0, 0])),
}


@for_each("name", TREES)
def test_bad_trees(tmp_path: Path, name: str) -> None:
    reason, change = TREES[name]
    tree, buffer = meshes.gltf_tree(BALL)
    change(tree)
    assert meshes.reason_of(meshes.write_glb(tmp_path / "a.glb", tree, buffer)) == reason


HARMLESS: dict[str, Change] = {
    "draco beside plain data": _add_draco,
    "targets without weights": lambda t: _add_targets(t, None, None),
    "targets of weight zero": lambda t: _add_targets(t, [0.0, 0.0], None),
    "a node that undoes the mesh's weights": lambda t: _add_targets(t, [1.0, 0.0], [0.0, 0.0]),
    "a skin that no placed node uses": lambda t: t.update(skins=[{"joints": [0]}]),
    "required materials": _requires("KHR_materials_unlit"),
    "an empty extension": lambda t: t["buffers"][0].update(extensions={"EXT_other": {}}),
}


def test_what_changes_no_vertex_is_read_as_if_it_were_not_there(tmp_path: Path) -> None:
    plain = meshes.prepare(meshes.write_glb(tmp_path / "a.glb", *meshes.gltf_tree(BALL)))
    for name, change in HARMLESS.items():
        tree, buffer = meshes.gltf_tree(BALL)
        change(tree)
        changed = meshes.prepare(meshes.write_glb(tmp_path / "b.glb", tree, buffer))
        assert meshes.geometry(changed) == meshes.geometry(plain), name


def test_instances_count_as_faces_and_buffers_do_not_lead_out(tmp_path: Path) -> None:
    tree, buffer = meshes.gltf_tree(BALL)
    tree["nodes"] = [{"children": list(range(1, 101))}] + [{"mesh": 0}] * 100
    path = meshes.write_glb(tmp_path / "a.glb", tree, buffer)
    assert meshes.reason_of(path, AssetSettings(max_source_faces=7999)) == "too_many_faces"
    path = meshes.secret_beside(tmp_path, bytes(10_000)) / "a.gltf"
    for uri in (*meshes.OUTSIDE, "gone.bin"):
        tree["buffers"][0]["uri"] = uri
        path.write_text(json.dumps(tree))
        expected = "missing_file" if uri == "gone.bin" else "external_uri"
        assert meshes.reason_of(path) == expected, uri


WATCH = """
import json, sys
from pathlib import Path
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


def test_an_obj_opens_no_material_and_a_gltf_its_buffers_and_no_picture(tmp_path: Path) -> None:
    """Files and sockets that a fresh process opens while it prepares each, by audit hook."""
    (tmp_path / "secret.mtl").write_text("newmtl a\nmap_Kd ../../../../../etc/hostname\n")
    (tmp_path / "objects").mkdir()
    material = meshes.write_obj(tmp_path / "objects" / "a.obj", meshes.knot(segments=80))
    heading = "mtllib ../secret.mtl\nmtllib /etc/hostname\nusemtl a\n"
    material.write_text(heading + material.read_text())
    tree, buffer = meshes.gltf_tree(meshes.sphere())
    tree["buffers"][0]["uri"] = "a.bin"
    tree["images"] = [{"uri": "../../etc/hostname"}, {"uri": "http://127.0.0.1:1/a.png"}]
    tree["textures"] = [{"source": 0}, {"source": 1}]
    tree["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    tree["meshes"][0]["primitives"][0]["material"] = 0
    (tmp_path / "a.bin").write_bytes(buffer)
    textured = tmp_path / "a.gltf"
    textured.write_text(json.dumps(tree))
    output = printed_by(WATCH, str(material), str(textured))
    opened = [json.loads(line) for line in output.splitlines()[-2:]]
    assert opened == [[str(material)], [str(textured), str(tmp_path / "a.bin")]]


def outcome(bench: Bench, mesh: TriangleMesh, **settings: Any) -> Asset | str:
    """Return the asset of a mesh that a child prepares, or the reason for having none."""
    meshes.write_off(bench.root / "a.off", mesh)
    prepared, failures = bench.run("a.off", settings=AssetSettings(**settings))
    if failures:
        return failures[0].reason
    asset = bench.stored(prepared[0])
    meshes.check_levels(asset)
    return asset


def asset_of(bench: Bench, mesh: TriangleMesh, **settings: Any) -> Asset:
    asset = outcome(bench, mesh, **settings)
    assert isinstance(asset, Asset), asset
    return asset


def used_methods(asset: Asset) -> set[str]:
    return {level.record.method for level in asset.levels}


MESHOPTIMIZER = {"meshoptimizer", "meshoptimizer_sloppy"}


def test_faces_with_repeated_corners_are_dropped_and_both_sides_count_once(bench: Bench) -> None:
    one = meshes.knot(80)
    doubled = meshes.with_faces(one, np.concatenate([one.faces, one.faces[::3, [0, 1, 1]]]))
    dirty = asset_of(bench, doubled, budgets=(500,))
    tidy = asset_of(bench, one, budgets=(500,))
    sides = meshes.joined(one, meshes.with_faces(one, one.faces[:, ::-1]))
    both = asset_of(bench, sides, budgets=(500,))
    assert dirty.geometry_sha256 == tidy.geometry_sha256
    assert dirty.source.repaired and not tidy.source.repaired
    assert dirty.source.num_faces_read == 1920 + 640
    assert both.source.num_faces == 1920
    assert both.source.watertight


def test_many_faces_on_one_edge_or_vertex_end_without_pymeshlab(bench: Bench) -> None:
    for pages in (8, 9, 400):
        asset = asset_of(bench, meshes.book(pages), budgets=(1400, 340, 240))
        assert asset.levels[0].record.method == "source"
        assert asset.source.nonmanifold_edges == 1
    assert used_methods(asset) <= {"source", *MESHOPTIMIZER}
    assert used_methods(asset_of(bench, meshes.fan(600), budgets=(500,))) <= MESHOPTIMIZER


@for_each("profile", ["faithful", "uniform"])
def test_a_random_soup_ends_with_a_reason_and_two_triangles_are_an_object(
    bench: Bench, profile: str
) -> None:
    rng = np.random.default_rng(0)
    soup = TriangleMesh(positions=rng.random((400, 3)), faces=rng.integers(0, 400, (1000, 3)))
    geometric = {"area_changed", "bbox_escaped", "budget_missed", "error_over_bound"}
    assert outcome(bench, soup, budgets=(500,), profile=profile) in {
        *geometric, "crashed_signal_11",
    }  # fmt: skip
    corners = np.array([[0, 0, 0], [4, 0, 0], [4, 3, 0], [0, 3, 0]], float)
    floor = TriangleMesh(positions=corners, faces=np.array([[0, 1, 2], [0, 2, 3]]))
    asset = asset_of(bench, floor, profile=profile)
    assert asset.source.num_parts == 1
    assert asset.source.front_share == pytest.approx(0.5, abs=0.2)


@pytest.mark.slow("hostile")
@pytest.mark.parametrize("profile", ["faithful", "uniform"])
def test_a_polygon_of_fifty_thousand_corners_ends(bench: Bench, profile: str) -> None:
    """Its hub has a valence of 50 000; the child of a run that used its seconds is killed."""
    found = outcome(bench, meshes.fan(50_000), budgets=(1400,), profile=profile)
    assert not str(found).startswith(("timeout", "crashed", "killed", "out_of_memory"))


@pytest.mark.parametrize("count", [50, pytest.param(5000, marks=pytest.mark.slow("hostile"))])
def test_many_boxes_do_not_fit_into_240_triangles(bench: Bench, count: int) -> None:
    places = np.random.default_rng(0).random((count, 3)) * 50
    boxes = meshes.joined(*(meshes.moved(meshes.cube(), 1.0, place) for place in places))
    expected = {"area_changed", "error_over_bound", "parts_lost", "budget_missed"}
    assert outcome(bench, boxes, budgets=(240,)) in expected
