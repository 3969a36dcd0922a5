"""Reading refuses glTF that would load wrongly; cleaning is exact, and turns faces outward."""

import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.assets.cleaning.clean import GRID, geometry_sha256
from pipeline.assets.cleaning.orient import orient_outward
from pipeline.assets.scene_mesh import load_scene_mesh
from pipeline.assets.settings import AssetSettings
from pipeline.foreign.mesh import TriangleMesh
from storage.errors import Rejected
from tests.for_each import for_each
from tests.pipeline.assets.meshes_by_hand import (
    as_rows,
    cleaned,
    flip_some,
    geometry,
    gltf_tree,
    knot,
    prepare,
    reason_of,
    sphere,
    volume,
    write_glb,
    write_obj,
)
from tests.pipeline.assets.source_materials.test_bad_pictures import OUTSIDE

BALL = sphere(rings=5, columns=8)


def _broken_tree(change: Callable[[dict[str, Any]], None]) -> tuple[dict[str, Any], bytes]:
    tree, buffer = gltf_tree(BALL)
    change(tree)
    return tree, buffer


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


TREES: dict[str, tuple[str, Callable[[dict[str, Any]], None]]] = {
    "own child": ("scene_cycle", lambda t: t["nodes"][0].update(children=[0])),
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
    "meshopt": (
        "compressed_geometry",
        lambda t: t.update(extensionsRequired=["EXT_meshopt_compression"]),
    ),
    "meshopt with a place-holder": (
        "compressed_geometry",
        lambda t: t["buffers"].append(
            {"byteLength": 9999, "extensions": {"EXT_meshopt_compression": {"fallback": True}}}
        ),
    ),
    "draco, not required, without plain data": (
        "compressed_geometry",
        lambda t: _add_draco(t, plain=False),
    ),
    "skin": ("skinned_mesh", lambda t: t["nodes"][0].update(skin=0)),
    "weights of no kind": ("load_error", lambda t: t["nodes"][0].update(weights=7)),
    "extensions of no kind": ("load_error", lambda t: t["buffers"][0].update(extensions=[1])),
    "unknown extension": (
        "unsupported_extension",
        lambda t: t.update(extensionsRequired=["EXT_something_new"]),
    ),
    "draco": (
        "compressed_geometry",
        lambda t: t.update(extensionsRequired=["KHR_draco_mesh_compression"]),
    ),
    "all zeros": ("extent_range", lambda t: t["accessors"][0].pop("bufferView")),
    "sparse of no kind": ("load_error", lambda t: t["accessors"][0].update(sparse={"count": 1})),
    "lines": ("no_faces", lambda t: t["meshes"][0]["primitives"][0].update(mode=1)),
    "accessor bomb": ("too_many_faces", lambda t: t["accessors"][1].update(count=2**40)),
    "accessor too long": ("load_error", lambda t: t["accessors"][1].update(count=3000)),
    "indices": ("index_range", lambda t: t["accessors"][0].update(count=20)),
    "no such node": ("load_error", lambda t: t["scenes"][0].update(nodes=[5])),
    "no such mesh": ("load_error", lambda t: t["nodes"][0].update(mesh=5)),
    "nan in a transform": (
        "nonfinite_vertices",
        lambda t: t["nodes"][0].update(translation=[float("nan"), 0, 0]),
    ),
    "scaled to nothing": ("extent_range", lambda t: t["nodes"][0].update(scale=[0, 0, 0])),
}


@for_each("name", TREES)
def test_bad_trees(tmp_path: Path, name: str) -> None:
    reason, change = TREES[name]
    tree, buffer = _broken_tree(change)
    assert reason_of(write_glb(tmp_path / "a.glb", tree, buffer)) == reason


HARMLESS: dict[str, Callable[[dict[str, Any]], None]] = {
    "draco beside plain data": _add_draco,
    "targets without weights": lambda t: _add_targets(t, None, None),
    "targets of weight zero": lambda t: _add_targets(t, [0.0, 0.0], None),
    "a node that undoes the mesh's weights": lambda t: _add_targets(t, [1.0, 0.0], [0.0, 0.0]),
    "a skin that no placed node uses": lambda t: t.update(skins=[{"joints": [0]}]),
    "required materials": lambda t: t.update(extensionsRequired=["KHR_materials_unlit"]),
    "an empty extension": lambda t: t["buffers"][0].update(extensions={"EXT_other": {}}),
}


@for_each("name", HARMLESS)
def test_what_changes_no_vertex_is_read_as_if_it_were_not_there(tmp_path: Path, name: str) -> None:
    tree, buffer = _broken_tree(HARMLESS[name])
    changed = prepare(write_glb(tmp_path / "a.glb", tree, buffer))
    plain = prepare(write_glb(tmp_path / "b.glb", *gltf_tree(BALL)))
    assert geometry(changed) == geometry(plain)


def test_instances_count_as_faces(tmp_path: Path) -> None:
    tree, buffer = gltf_tree(BALL)
    tree["nodes"] = [{"children": list(range(1, 101))}] + [{"mesh": 0}] * 100
    path = write_glb(tmp_path / "a.glb", tree, buffer)
    assert reason_of(path, AssetSettings(max_source_faces=7999)) == "too_many_faces"


@for_each("uri", OUTSIDE)
def test_buffers_do_not_lead_out(tmp_path: Path, uri: str) -> None:
    (tmp_path / "secret.png").write_bytes(bytes(10_000))
    folder = tmp_path / "objects"
    folder.mkdir()
    (folder / "link.png").symlink_to(tmp_path / "secret.png")
    tree, _ = gltf_tree(BALL)
    tree["buffers"][0]["uri"] = uri
    path = folder / "a.gltf"
    path.write_text(json.dumps(tree))
    assert reason_of(path) == "external_uri"


def test_a_missing_buffer_is_a_missing_file(tmp_path: Path) -> None:
    tree, _ = gltf_tree(BALL)
    tree["buffers"][0]["uri"] = "gone.bin"
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(tree))
    assert reason_of(path) == "missing_file"


SETTINGS = AssetSettings()


def test_remeshing_keeps_size_place_and_number(tmp_path: Path) -> None:
    moved = TriangleMesh(positions=3 * knot().positions + [5, -2, 1], faces=knot().faces)
    path = write_obj(tmp_path / "knot.obj", moved)
    as_it_is = load_scene_mesh(path, SETTINGS, None).mesh
    even = load_scene_mesh(path, SETTINGS, 1000).mesh
    assert len(as_it_is.faces) == len(moved.faces)
    assert 500 < len(even.faces) <= 1000
    for end in ("min", "max"):
        before, after = (getattr(mesh.positions, end)(axis=0) for mesh in (as_it_is, even))
        # A thousand triangles cut the corners of a tube by a few percent of its box at most.
        np.testing.assert_allclose(after, before, atol=0.03 * np.ptp(moved.positions))


def test_a_mesh_without_area_cannot_be_remeshed(tmp_path: Path) -> None:
    line = TriangleMesh(
        positions=np.outer(np.arange(6.0), [1.0, 2.0, 3.0]), faces=np.array([[0, 1, 2], [3, 4, 5]])
    )
    path = write_obj(tmp_path / "line.obj", line)
    assert len(load_scene_mesh(path, SETTINGS, None).mesh.faces) == 2
    with pytest.raises(Rejected) as caught:
        load_scene_mesh(path, SETTINGS, 100)
    assert caught.value.reason == "remesh_failed"


def same(a: TriangleMesh, b: TriangleMesh) -> bool:
    return np.array_equal(a.positions, b.positions) and np.array_equal(a.faces, b.faces)


def test_cleaning_centres_fits_float32_forgets_order_and_twice_is_once() -> None:
    result = cleaned(knot())
    low, high = result.positions.min(axis=0), result.positions.max(axis=0)
    # Each end is rounded to the grid on its own.
    np.testing.assert_allclose(low + high, 0, atol=1 / GRID)
    assert (high - low).max() == 1
    positions = cleaned(knot()).positions
    assert np.array_equal(positions.astype(np.float32).astype(np.float64), positions)
    mesh, rng = knot(), np.random.default_rng(1)
    order = rng.permutation(len(mesh.positions))
    faces = np.argsort(order)[mesh.faces][rng.permutation(len(mesh.faces))]
    turned = np.take_along_axis(faces, (rng.integers(0, 3, (len(faces), 1)) + np.arange(3)) % 3, 1)
    shuffled = TriangleMesh(positions=mesh.positions[order], faces=turned)
    assert same(cleaned(shuffled), cleaned(mesh))
    once = cleaned(sphere())
    assert same(cleaned(once), once)


@for_each(("scale", "offset"), itertools.product([1e-6, 0.37, 4.0, 1e7], [0.0, 12.3]))
def test_scale_and_offset_are_forgotten(scale: float, offset: float) -> None:
    mesh = knot()
    moved = TriangleMesh(positions=(mesh.positions + offset) * scale, faces=mesh.faces)
    assert same(cleaned(moved), cleaned(mesh))


def test_a_quarter_turn_turns_the_result() -> None:
    mesh = knot()
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = cleaned(TriangleMesh(positions=mesh.positions @ turn.T, faces=mesh.faces))
    straight = cleaned(mesh)
    assert as_rows(turned.positions, turned.faces) == as_rows(
        straight.positions @ turn.T, straight.faces
    )


def test_soup_is_welded_and_what_is_no_triangle_is_dropped() -> None:
    mesh = sphere()
    soup = mesh.corners.reshape(-1, 3)
    corners = np.arange(len(soup)).reshape(-1, 3)
    junk = [corners[:5], corners[7:9, ::-1], corners[:4, [0, 0, 1]]]
    on_a_line = np.array([[len(soup), len(soup) + 1, len(soup) + 2]])
    line = np.array([[0.0, 0, 0], [0.1, 0.1, 0.1], [0.2, 0.2, 0.2]])
    dirty = TriangleMesh(
        positions=np.concatenate([soup, line, [[0.5, 0.5, 0.5]]]),
        faces=np.concatenate([corners, *junk, on_a_line]),
    )
    result = cleaned(dirty)
    assert len(result.positions) == len(mesh.positions)
    assert as_rows(result.positions, result.faces) == as_rows(*_arrays(cleaned(mesh)))


def test_the_digest_forgets_winding_order_and_scale_but_not_shape() -> None:
    mesh = knot()
    digest = geometry_sha256(cleaned(mesh))
    copies = [
        TriangleMesh(positions=mesh.positions * 3.7, faces=mesh.faces[::-1]),
        TriangleMesh(positions=mesh.positions, faces=mesh.faces[:, ::-1]),
    ]
    assert {geometry_sha256(cleaned(copy)) for copy in copies} == {digest}
    others = [sphere(), knot(segments=161), _moved_vertex(mesh, 1e-3)]
    assert digest not in {geometry_sha256(cleaned(other)) for other in others}


def _moved_vertex(mesh: TriangleMesh, distance: float) -> TriangleMesh:
    positions = mesh.positions.copy()
    positions[17, 2] += distance
    return TriangleMesh(positions=positions, faces=mesh.faces)


def _arrays(mesh: TriangleMesh) -> tuple[np.ndarray, np.ndarray]:
    return mesh.positions, mesh.faces


def oriented(mesh: TriangleMesh) -> TriangleMesh:
    return orient_outward(cleaned(mesh))[0]


@for_each(("share", "mesh"), itertools.product([0.0, 0.3, 1.0], [sphere(), knot()]))
def test_flipped_faces_are_turned_back(share: float, mesh: TriangleMesh) -> None:
    right = cleaned(mesh).faces
    flipped = oriented(flip_some(mesh, share, np.random.default_rng(2)))
    assert np.array_equal(flipped.faces, right)


def test_each_of_several_bodies_is_turned_on_its_own() -> None:
    ball = sphere()
    count = len(ball.positions)
    both = TriangleMesh(
        positions=np.concatenate([ball.positions, ball.positions + 3]),
        faces=np.concatenate([ball.faces, ball.faces[:, ::-1] + count]),
    )
    mesh = oriented(both)
    centres = mesh.corners.mean(axis=1)
    middle = np.where(centres[:, :1] > 0, 1, -1) * np.abs(centres).mean(axis=0)
    outward = np.einsum("ij,ij->i", mesh.double_area_vectors, centres - middle)
    assert (outward > 0).all()


def test_a_hidden_body_is_oriented_by_its_volume() -> None:
    outer, inner = sphere(), sphere(rings=5, columns=8)
    nested = TriangleMesh(
        positions=np.concatenate([outer.positions, 0.3 * inner.positions]),
        faces=np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.positions)]),
    )
    mesh = oriented(nested)
    alone = np.linalg.norm(mesh.corners, axis=2).max(axis=1) < 0.2
    inside = TriangleMesh(positions=mesh.positions, faces=mesh.faces[alone])
    assert alone.sum() == len(inner.faces)
    assert volume(inside) > 0


def test_an_open_cup_keeps_its_outside_out() -> None:
    ball = sphere()
    below = ball.positions[ball.faces].mean(axis=1)[:, 2] < 0.2
    cup = TriangleMesh(positions=ball.positions, faces=ball.faces[below])
    right = cleaned(cup).faces
    flipped = oriented(flip_some(cup, 0.3, np.random.default_rng(3)))
    assert np.array_equal(flipped.faces, right)
