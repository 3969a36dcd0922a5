"""Meshes and their materials: as written in every dialect, and alike as object and as scene."""

import itertools
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pxr import Gf, Usd, UsdGeom, UsdLux, UsdShade

from pipeline.assets.quality.measure import Surface
from pipeline.assets.settings import OwnMaterialSettings
from pipeline.assets.source_materials.skin import _parts
from pipeline.assets.source_materials.source_surface import FacePoints, SourceSurface
from pipeline.exchange.reader import load_source, scene_source
from pipeline.exchange.renderformer_json import read_renderformer_json
from pipeline.foreign.gltf.document import data_uri_bytes
from pipeline.foreign.limits import ReadLimits
from pipeline.foreign.material import LEAST_ROUGHNESS, SourceMaterial
from pipeline.foreign.mesh import FileMesh
from pipeline.foreign.mesh_materials import read_textured_mesh
from pipeline.foreign.numbers import FINITE
from pipeline.foreign.picture import FilePictures, read_linear_picture
from pipeline.foreign.polygons import triangulate
from pipeline.foreign.source_file import SourceFile, load_mesh, read_source
from storage.conventions import linear_from_srgb8
from storage.errors import Rejected, TrilightError
from storage.records.exr import encode_channels
from storage.records.lookup import textured_rows
from storage.records.material import ROUGHNESS
from tests.for_each import case, for_each
from tests.pipeline.assets.meshes_by_hand import write_glb
from tests.pipeline.assets.source_materials import textured_kit as kit
from tests.pipeline.exchange.exchange_kit import build_json
from tests.pipeline.exchange.test_renderformer_json import MATERIAL, TRANSFORM, changed
from tests.pipeline.foreign.dialects import WRITERS, Polygons, Rng, draw_polygons

KINDS = list(WRITERS)
RANDOM = st.randoms(use_true_random=False)


def source(kind: str, data: bytes) -> SourceFile:
    return SourceFile(kind=kind, data=data, sha256="")


def by_color(contents: FileMesh, mesh: Polygons) -> dict[int, float]:
    """Return the area of each polygon by its color, or by its material's number."""
    area = np.linalg.norm(contents.mesh.double_area_vectors, axis=1) / 2
    rows = None
    if contents.material_names:
        number = [int(name.removeprefix("größe ")) for name in contents.material_names]
        rows = np.array(number)[contents.material]
    if contents.color is not None:
        table = linear_from_srgb8()[np.array(mesh.colors)]
        away = np.abs(contents.color[:, :, None] - table).max(axis=-1)
        assert (away.min(axis=-1) < 1e-5).all()
        of_color = away[:, 0].argmin(axis=-1)
        assert rows is None or np.array_equal(rows, of_color)
        rows = of_color
    assert rows is not None
    return dict(enumerate(np.bincount(rows, area)))


@settings(max_examples=150, deadline=None)
@given(rng=RANDOM, kind=st.sampled_from(KINDS))
def test_a_mesh_is_read_as_it_was_written(rng: Rng, kind: str) -> None:
    mesh = draw_polygons(rng, 3 if kind == "stl" else 9)
    read = source(kind, WRITERS[kind](mesh, rng))
    triangles, contents = load_mesh(read), read.contents
    assert len(triangles.faces) == sum(len(ring) - 2 for ring in mesh.rings)
    corners = {tuple(point) for point in triangles.corners.reshape(-1, 3)}
    assert corners == {tuple(point) for point in mesh.points}
    if contents.color is None and not contents.material_names:
        area = np.linalg.norm(triangles.double_area_vectors, axis=1).sum() / 2
        assert kind == "stl" and area == pytest.approx(sum(mesh.areas), rel=1e-6)
        return
    assert by_color(contents, mesh) == pytest.approx(dict(enumerate(mesh.areas)), rel=1e-6)
    if contents.uv is not None:
        is_mapped = np.array_equal(contents.uv, triangles.corners[..., :2])
        assert is_mapped or np.isnan(contents.uv).all()
    named = {
        "obj": set(),
        "off": {"more numbers of vertices"},
        "stl": set(),
        "ply": {"element 'edge'", "property 'flags' of face", "property 'quality' of vertex"},
    }
    assert {text.partition(" x ")[2] or text for text in read.unread} <= named[kind]


@settings(max_examples=150, deadline=None)
@given(rng=RANDOM, kind=st.sampled_from(["ply", "stl", "off"]), place=st.floats(0, 1))
def test_a_file_that_ends_early_is_refused_or_whole(rng: Rng, kind: str, place: float) -> None:
    mesh = draw_polygons(rng, 3 if kind == "stl" else 9)
    data = WRITERS[kind](mesh, rng)
    cut = data[: int(place * (len(data) - 1))]
    if kind != "stl" and cut[-1:].isdigit() and not data[len(cut) :].split(None, 1)[1:]:
        return  # within its last number, which then is another one
    if kind == "stl" and re.search(rb"endfacet\s+endsolid[^\n]*\n?$", cut.lower()):
        return  # behind the first of two solids
    try:
        left = load_mesh(source(kind, cut))
    except Rejected as refusal:
        assert refusal.reason in {"header_size_mismatch", "cut_off", "load_error"}, refusal
    else:
        whole = load_mesh(source(kind, data))
        assert np.array_equal(left.corners, whole.corners)


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
READ: dict[str, tuple[str, int, str | bytes, tuple[str, ...]]] = {
    "keyhole": ("obj", 8, "v 0 0 0\nv 3 0 0\nv 3 3 0\nv 0 3 0\nv 1 1 0\nv 1 2 0\nv 2 2 0\nv 2 1 0\n"
                "f 1 2 3 4 1 5 6 7 8 5\n", ()),
    "free form": ("obj", 1, TRIANGLE + "cstype bezier\ncurv 0 1 1 2\np 1\nf 1 2 3\n",
                  ("statement 'cstype'", "statement 'curv'", "statement 'p'")),
    "no such vt": ("obj", 1, TRIANGLE + "f 1/7 2/8 3/9\n",
                   ("texture coordinates that the file does not hold",)),
    "strips": ("ply", 3, "ply\nformat ascii 1.0\nelement vertex 4\nproperty double x\n"
               "property double y\nproperty double z\nelement tristrips 1\n"
               "property list int int vertex_indices\nend_header\n"
               "0 0 0\n1 0 0\n0 1 0\n1 1 0\n8 0 1 2 3 -1 2 1 0\n", ()),
    "no header": ("off", 1, "3 1 0 0 0 0 1 0 0\n0 1 0 3 0\n1 2\n", ()),
    "colors with alpha": ("obj", 1, "v 0 0 0 1 0 0 .5\nv 1 0 0 0 0 0 1\nv 0 1 0 0 0 0 1\nf 1 2 3\n",
                          ("transparency of colors",)),
    "loose stl": ("stl", 3, "solid a\ncolor 1 0 0\nfacet normal\nouter loop\nvertex 0 0 0\n"
                  "vertex 1 0 0\nvertex 1 1 0\nvertex 0 1 0\nvertex -1 .5 0\nend loop\nend facet\n"
                  "end solid\nfrom a mill", ("statement 'color'",)),
    "stl with a tail": ("stl", 1, b"solid".ljust(80) + b"\1\0\0\0" + bytes(12)
                        + np.eye(3, dtype="<f4").tobytes() + b"\0\0\n",
                        ("bytes after the last facet",)),
    "stl attributes": ("stl", 1, b"COLOR=".ljust(80) + b"\1\0\0\0" + bytes(12) + np.eye(
        3, dtype="<f4").tobytes() + b"\1\x80",
        ("attributes of facets, which often are colors", "color of the header")),
}  # fmt: skip


@for_each("name", READ)
def test_what_is_read_and_what_is_named(name: str) -> None:
    kind, count, text, unread = READ[name]
    read = source(kind, text if isinstance(text, bytes) else text.encode())
    mesh = load_mesh(read)
    assert len(mesh.faces) == count and read.unread == unread
    if name == "keyhole":
        assert np.linalg.norm(mesh.double_area_vectors, axis=1).sum() / 2 == pytest.approx(8)
    if name == "strips":
        assert (mesh.double_area_vectors[:2, 2] > 0).all() and not read.is_single


BY_MESHLAB = "# OBJ File Generated by Meshlab\n"
REFUSED = {
    "obj within a face": ("obj", "cut_off", TRIANGLE + "f 1 2"),
    "obj within a vertex": ("obj", "cut_off", TRIANGLE + "f 1 2 3\nv 1 2"),
    "obj zero": ("obj", "index_range", TRIANGLE + "f 0 1 2\n"),
    "obj too far back": ("obj", "index_range", TRIANGLE + "f -1 -2 -4\n"),
    "obj no number": ("obj", "load_error", TRIANGLE + "f 1 2 3x\n"),
    "obj of MeshLab": ("obj", "cut_off", BY_MESHLAB + TRIANGLE),
    "obj of curves": ("obj", "no_faces", TRIANGLE + "curv 0 1 1 2\n"),
    "obj float index": ("obj", "b'1.0' stands where a whole number", TRIANGLE + "f 1.0 2 3\n"),
    "stl of half a facet": ("stl", "'facet' where a facet is not complete",
                            "solid a\nfacet normal 0 0 1\nvertex 0 0 0\nendfacet\nendsolid a\n"),
    "stl of other bytes": ("stl", "its header counts 538976288 facets", "# " + " " * 99),
    "stl without end": ("stl", "cut_off", "solid a\n"),
    "off binary": ("off", "load_error", "OFF BINARY\n3 1 0\n"),
    "off of four dimensions": ("off", "load_error", "nOFF 4\n3 1 0\n"),
    "ply of uncounted faces": ("ply", "header_size_mismatch: the PLY header counts b'-5'",
                               "ply\nformat ascii 1.0\nelement face -5\nend_header\n"),
    "ply of another format": ("ply", "load_error", "ply\nformat xml 1.0\nend_header\n"),
}  # fmt: skip


@for_each("name", REFUSED)
def test_what_is_refused(name: str) -> None:
    kind, reason, text = REFUSED[name]
    with pytest.raises(Rejected) as refusal:
        load_mesh(source(kind, text.encode()))
    assert reason in f"{refusal.value.reason}: {refusal.value.message}"


def test_colors_of_zbrush_and_of_ply_in_other_codes_are_read() -> None:
    red = tuple(linear_from_srgb8()[[200, 30, 30]].tolist())
    codes = {"float": "200.0 30.0 30.0", "ushort": "200 30 30", "int": "200 30 30"}
    files = [
        ("ply", "ply\nformat ascii 1.0\nelement vertex 3\nproperty float X\nproperty float Y\n"
         f"property float Z\nproperty {kind} Red\nproperty {kind} Green\nproperty {kind} Blue\n"
         "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
         f"0 0 0 {code}\n1 0 0 {code}\n0 1 0 {code}\n3 0 1 2\n") for kind, code in codes.items()
    ]  # fmt: skip
    files.append(("obj", TRIANGLE + "#MRGB " + "ffc81e1e" * 3 + "\nf 1 2 3\n"))
    for kind, text in files:
        color = source(kind, text.encode()).contents.color
        assert color is not None and color[0, 0] == pytest.approx(red, abs=1e-6)


@for_each("count", [40, 3000])
def test_a_comb_is_cut_as_it_is(count: int) -> None:
    """Every second corner is drawn in; more corners than were ever cut by ears count alike."""
    turn = 2 * np.pi * np.arange(count) / count
    ring = np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    ring *= np.where(np.arange(count) % 2, 0.5, 1.0)[:, None]
    corners, _ = triangulate(ring, np.array([count]), np.arange(count))
    cross = np.cross(*(ring[corners[:, k]] - ring[corners[:, 0]] for k in (1, 2)))[:, 2]
    assert len(corners) == count - 2 and (cross > 0).all()
    assert cross.sum() / 2 == pytest.approx(count / 4 * np.sin(2 * np.pi / count))


MTL = "Kd xyz 0.4124 0.2126 0.0193\nillum 2 # x\nd -halo 0.5\nsharpness 60\nsparkle 1\nTr 0\n"
MTL += "map_Ks\nKs .5 .5 1.1\n"


def placed(folder: Path, obj: bytes, files: dict[str, bytes]) -> Path:
    """Write an OBJ of one square with what it names, below a folder of a root."""
    path = folder / "a" / "models" / "a.obj"
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [f"v {x} {y} {z}\n" for x, y, z in kit.SQUARE.positions]
    rows += [f"vt {u} {v}\n" for u, v in kit.UV_UP]
    path.write_bytes("".join(rows).encode() + obj + b"f 1/1 2/2 3/3 4/4\n")
    for name, data in files.items():
        (path.parent / name).parent.mkdir(exist_ok=True, parents=True)
        (path.parent / name).write_bytes(data)
    return path


PICTURE = kit.picture_bytes(np.full((4, 4, 3), [255, 0, 0], np.uint8))
SPELLINGS: dict[str, tuple[bytes, str]] = {
    "as it is": (b"map_Kd a b.png", "a b.png"),
    "quoted": (b'map_Kd "a b.png"', "a b.png"),
    "options": (b"map_Kd -blendu on -mm 0 1 -o 0 0 0 -s 1 -texres 4 -cc off a  b.png", "a  b.png"),
    "a comment": (b"map_Kd a.png # x", "a.png"),
    "escaped": (b"map_Kd a%20b.png", "a b.png"),
    "another case": (b"map_Kd Maps\\A.PNG", "maps/a.png"),
    "of another machine": (b"map_Kd C:\\Users\\x\\a.png", "a.png"),
    "above": (b"map_Kd ..\\images\\a.png", "../images/a.png"),
    "beside its library": (b"map_Kd a.png", "more/a.png"),
    "scanned objects": (b"map_Kd a.png", "../materials/textures/a.png"),
    "latin-1": ("map_Kd größe.png".encode("latin-1"), "größe.png"),
    "shift-jis": ("map_Kd 木.png".encode("cp932"), "木.png"),
}  # fmt: skip


@for_each("name", SPELLINGS)
def test_pictures_are_found_however_their_names_are_spelled(tmp_path: Path, name: str) -> None:
    statement, place = SPELLINGS[name]
    library = b"newmtl m\n" + statement + b"\n"
    files = {"more/c.mtl": library, place: PICTURE}
    path = placed(tmp_path, b"mtllib b.mtl more/c.mtl\nusemtl m\n", files)
    read = read_source(path, ReadLimits(with_materials=True), tmp_path)
    assert [data for data in read.materials.data.values() if data == PICTURE] == [PICTURE]


def test_nothing_is_read_outside_of_the_folder_that_was_given(tmp_path: Path) -> None:
    root = tmp_path / "root"
    for spelling in (b"../../../x.png", b"link/x.png", bytes(tmp_path / "x.png")):
        path = placed(root, b"mtllib c.mtl\nusemtl m\n", {"c.mtl": b"newmtl m\nmap_Kd " + spelling})
        (tmp_path / "x.png").write_bytes(PICTURE)
        (path.parent / "link").unlink(missing_ok=True)
        (path.parent / "link").symlink_to(tmp_path)
        read = read_source(path, ReadLimits(with_materials=True), root)
        (reason,) = read.materials.refused.values()
        assert reason.reason == "texture_outside"


def test_statements_of_an_mtl_are_read_or_named(tmp_path: Path) -> None:
    from pipeline.assets.prepare import prepare_asset

    files = {"m.mtl": b"\xef\xbb\xbfnewmtl\tm #1\r\n" + MTL.replace("\n", "\r\n").encode()}
    path = placed(tmp_path, b"usemtl m #1\nmtllib m.mtl\n", files)
    made = prepare_asset(path, kit.KEEP, "meshoptimizer")
    assert made.asset.materials is not None and made.asset.materials.lost == ("transparency",)
    assert made.unread == ("statement 'sparkle'", "ks above 1")
    red, green, blue = kit.seen_at(made.asset, 0, 0)
    assert red > 0.9 and max(green, blue) < 0.02


def test_a_missing_material_and_cut_values_are_named_and_cost_nothing_else(tmp_path: Path) -> None:
    wide = encode_channels({"RGB": np.full((4, 4, 3), 1.5, np.float32)})
    files = {"m.mtl": b"newmtl m\nmap_Kd w.exr\n", "w.exr": wide}
    path = placed(tmp_path, b"mtllib m.mtl\nusemtl m\nf 1/1 2/2 3/3\nusemtl gone\n", files)
    read = read_source(path, ReadLimits(with_materials=True), tmp_path)
    pictures = FilePictures(1 << 20)
    parts = read_textured_mesh(read, pictures, emission=False)
    bases = [parts.materials[row].base for row in parts.material]
    assert sorted(base is None for base in bases) == [False, True, True]
    assert read.notes == ["material 'gone': no library has it; its faces have MTL's defaults"]
    assert pictures.notes == ["picture 'w.exr': values beyond [0, 1] (0 to 1.5)"]


SHAPES: dict[str, tuple[int, float | None]] = {
    "01-obj-concave-polygon/in/u.obj": (28, 30.0),
    "04-obj-interleaved-negative/in/two.obj": (24, 12.0),
    "06a-ply-binary-mixed/in/pyramid.ply": (6, None),
    "07a-stl-facet-on-one-line/in/one-line-a-facet.stl": (12, None),
    "08a-stl-key-words-in-names/in/key-word-names.stl": (24, None),
    "10a-obj-second-group-indented/in/second-group-indented.obj": (12, None),
    "10b-obj-tab-separated/in/tab-separated.obj": (12, None),
    "60-ply-double-utm/in/block.ply": (12, None),
}
RED, BLUE = (0.8, 0.05, 0.05), (0.05, 0.1, 0.7)
SEEN_RED, SEEN_BLUE = (0.578, 0.013, 0.013), (0.013, 0.013, 0.578)
SHADES = {
    "17a-mtl-tabs/in/cube.obj": {RED: 0.5, BLUE: 0.5},
    "18a-obj-latin1-names/in/cube.obj": {(0.05, 0.6, 0.05): 0.5, (0.9, 0.9, 0.9): 0.5},
    "20-shapenet-layout/in/03001627/abc/models/model_normalized.obj": {
        SEEN_RED: 0.5,
        SEEN_BLUE: 0.5,
    },
    "21-bop-ply-texture/in/coloured/obj_000002.ply": {(0.013, 0.352, 0.013): 1.0},
    "21-bop-ply-texture/in/textured/obj_000001.ply": {SEEN_RED: 0.5, SEEN_BLUE: 0.5},
    "28a-mtl-halo/in/cube.obj": {RED: 0.5, BLUE: 0.5},
}


def test_shapes_of_public_reports(shared: Path) -> None:
    for name, (count, area) in SHAPES.items():
        with case(name):
            mesh = load_mesh(read_source(shared / "cases" / name, ReadLimits()))
            assert len(mesh.faces) == count
            if area is not None:
                double = np.linalg.norm(mesh.double_area_vectors, axis=1).sum()
                assert double / 2 == pytest.approx(area)
    off = shared / "cases/09a-off-glued-cut-off/in/glued-cut-off.off"
    with pytest.raises(Rejected, match="header_size_mismatch"):
        load_mesh(read_source(off, ReadLimits()))
    for name in ("46-json-concave-polygon/in/scene.json", "45-json-windows-paths/in/windows.json"):
        path = shared / "cases" / name
        built = build_json(path.parent, path.name)
        corners = built.vertex_positions[built.faces[built.object_index == 0]].astype(np.float64)
        vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        double = np.linalg.norm(vectors, axis=1).sum()
        assert double / 2 == pytest.approx(1.2, rel=1e-5), name


def test_shades_of_public_reports(shared: Path) -> None:
    """The base color at the middle of each face, by area."""
    for name, shades in SHADES.items():
        with case(name):
            path = shared / "cases" / name
            root = shared / "cases" / name.partition("/")[0] / "in"
            read = read_source(path, ReadLimits(with_materials=True), root)
            parts = read_textured_mesh(read, FilePictures(1 << 20), emission=False)
            area = np.linalg.norm(parts.mesh.double_area_vectors, axis=1) / 2
            found = Counter[tuple[float, ...]]()
            for face, share in enumerate(area / area.sum()):
                material: SourceMaterial = parts.materials[parts.material[face]]
                color = np.array(material.base_rgb)
                if parts.color is not None:
                    color = color * parts.color[face].mean(axis=0)
                if material.base is not None:
                    middle = parts.uv[face, 0].mean(axis=0)[None]
                    color = color * material.base.picture.sample(middle, np.zeros(1, int))[0, :3]
                found[tuple(np.round(color, 3).tolist())] += share
            assert dict(found) == pytest.approx(shades)


def test_buffers_are_found_in_any_case_and_in_both_base64s(tmp_path: Path) -> None:
    tree, buffer = kit.textured_tree(PICTURE)
    (tmp_path / "My Mesh.bin").write_bytes(buffer)
    for uri in ("my%20mesh.BIN", "gone.bin"):
        tree["buffers"][0]["uri"] = uri
        (tmp_path / "a.gltf").write_text(json.dumps(tree))
        if uri == "gone.bin":
            with pytest.raises(Rejected, match="missing_file.*the buffer 'gone.bin': there is no"):
                read_source(tmp_path / "a.gltf", ReadLimits())
        else:
            assert len(load_mesh(read_source(tmp_path / "a.gltf", ReadLimits())).faces) == 2
    assert data_uri_bytes("data:;base64,-_8") == data_uri_bytes("data:;base64,+/8=")


CODED = 0.009
"""A step of 8 sRGB-encoded bits near white: both albedos together stay below 1."""

WEIGHTS = np.array([[0.25, 0.5, 0.25], [0.1, 0.2, 0.7], [0.7, 0.1, 0.2]])
TWIN_PICTURE = np.kron(
    np.concatenate([kit.CORNERS, kit.CORNERS[::-1] // 2], axis=1), np.ones((16, 16, 1), np.uint8)
)
"""[32, 64, 3]; a scene's own textures repeat, so that clamped borders differ by half a texel."""
WIDE = kit.UV_UP * [2.25, 1] + [0.75, 0]


def assert_same(path: Path) -> None:
    source = read_source(path, kit.KEEP.read_limits)
    parts = _parts(source, FilePictures(1 << 20), OwnMaterialSettings())
    scene = load_source(scene_source(str(path))).scene
    count = len(parts.mesh.faces)
    corners = scene.vertex_positions[scene.faces[:count]]
    np.testing.assert_allclose(corners, parts.mesh.corners, atol=1e-6)
    surface = SourceSurface(
        surface=Surface(parts.mesh, np.zeros((1, 3))),
        parts=parts,
        source_face=np.arange(count),
        source_corner=np.tile(np.arange(3), (count, 1)),
    )
    for weights in WEIGHTS:
        each = np.tile(weights, (count, 1))
        expected = surface.columns(FacePoints(np.arange(count), each), 1e-9)
        uv = np.zeros((count, 2))
        if scene.uv is not None:
            uv = np.einsum("c,tcd->td", weights, scene.uv.reshape(-1, 3, 2)[:count])
        rows = textured_rows(scene, scene.material_index[:count], uv.astype(np.float64))
        rows[:, ROUGHNESS] = np.maximum(rows[:, ROUGHNESS], LEAST_ROUGHNESS)  # that of objects
        np.testing.assert_allclose(rows[:, :7], expected, atol=CODED)


def stated(path: str, values: Mapping[str, Any]) -> Callable[[Usd.Stage], None]:
    return lambda stage: kit.set_inputs(stage, path, values)


def turned(stage: Usd.Stage) -> None:
    kit.transform_coordinates(stage, 90.0, (0.5, 0.75), (1, 0.125))


def tinted(stage: Usd.Stage) -> None:
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(kit.MESH))
    UsdShade.MaterialBindingAPI(mesh).UnbindAllBindings()
    mesh.CreateDisplayColorPrimvar("uniform").Set([(0.9, 0.1, 0.3), (0.2, 0.4, 0.8)])


SPECULAR = {"specularFactor": 0.5, "specularColorFactor": [1, 0.5, 0]}
GLOSSY = {
    "diffuseTexture": {"index": 0},
    "glossinessFactor": 0.5,
    "specularFactor": [0.2, 0.3, 0.1],
}
SCALED = {"scale": Gf.Vec4f(1, 0.5, 0.75, 1), "bias": Gf.Vec4f(0, 0.25, -0.125, 0)}


@for_each(
    "change, connect",
    [
        (stated(kit.SHADER, {"roughness": 0.3}), {"diffuseColor": "rgb"}),
        (stated(kit.TEXTURE, {"sourceColorSpace": "raw"}), {"diffuseColor": "rgb"}),
        (stated(kit.TEXTURE, SCALED), {"diffuseColor": "rgb"}),
        (stated(kit.TEXTURE, {"sourceColorSpace": "raw"}), {"roughness": "g"}),
        (stated(kit.SHADER, {"roughness": 0.3}), {"diffuseColor": "rgb", "metallic": "g"}),
        (stated(kit.SHADER, {"ior": 2.0}), {"diffuseColor": "b"}),
        (stated(kit.SHADER, {"useSpecularWorkflow": 1}), {"specularColor": "rgb"}),
        (stated(kit.TEXTURE, {"wrapS": "mirror"}), {"diffuseColor": "rgb"}),
        (stated(kit.TEXTURE, {"wrapS": "clamp"}), {"diffuseColor": "rgb"}),
        (stated(kit.TEXTURE, {"wrapS": "black"}), {"diffuseColor": "rgb"}),
        (turned, {"diffuseColor": "rgb"}),
        (tinted, {"diffuseColor": "rgb"}),
    ],
)
def test_usd(
    tmp_path: Path, change: Callable[[Usd.Stage], None], connect: Mapping[str, str]
) -> None:
    def edit(stage: Usd.Stage) -> None:
        change(stage)
        UsdGeom.Mesh(stage.GetPrimAtPath(kit.MESH)).CreateSubdivisionSchemeAttr("none")
        UsdLux.RectLight.Define(stage, "/lamp")

    picture = kit.picture_bytes(TWIN_PICTURE)
    assert_same(kit.textured_usd(tmp_path / "a.usda", picture, edit, uv=WIDE, connect=connect))


@for_each(
    "material",
    [
        {},
        {"pbrMetallicRoughness": {"metallicFactor": 1, "baseColorFactor": [0.9, 0.4, 0.2, 1]}},
        {"pbrMetallicRoughness": {"metallicRoughnessTexture": {"index": 0}}},
        {"extensions": {"KHR_materials_unlit": {}}},
        {"extensions": {"KHR_materials_ior": {"ior": 2.0}}},
        {"extensions": {"KHR_materials_specular": SPECULAR}},
        {"extensions": {"KHR_materials_pbrSpecularGlossiness": GLOSSY}},
    ],
)
@for_each("sampler", [{}, {"wrapS": 33071}, {"wrapS": 33648, "wrapT": 33071}])
def test_gltf(tmp_path: Path, material: Mapping[str, Any], sampler: Mapping[str, int]) -> None:
    tree, buffer = kit.textured_tree(kit.picture_bytes(TWIN_PICTURE), WIDE)
    tree["materials"][0] |= material
    tree["samplers"] = [sampler]
    tree["textures"][0]["sampler"] = 0
    assert_same(write_glb(tmp_path / "a.glb", tree, buffer))


NUMBERS = (math.nan, math.inf, -math.inf, 1e39, -1e39, 0.0, 0.25, 1e3, -7.0)
SMALL_PICTURE = kit.picture_bytes(kit.CORNERS)


def look_at_parts(path: Path) -> str:
    """Read all of a file and return what is not read; what became of its numbers is finite."""
    source = read_source(path, kit.KEEP.read_limits)
    glowing = OwnMaterialSettings(emission=True)
    for material in _parts(source, FilePictures(1 << 20), glowing).materials:
        colors = (*material.base_rgb, *material.specular_rgb, *material.emission_rgb)
        numbers = (material.metallic, material.roughness, material.f0, material.specular_strength)
        moves = [[*slot.uv_matrix.flat, *slot.uv_offset] for slot in material.slots]
        assert np.isfinite([*colors, *numbers, *itertools.chain(*moves)]).all()
    return "; ".join(source.unread)


def gltf(folder: Path, where: str, name: str, value: Any) -> str:
    tree, buffer = kit.textured_tree(SMALL_PICTURE)
    row = tree["materials"][0]
    if where == "emissive_strength":
        row["emissiveFactor"] = [1, 1, 1]
    if where in ("metal", "uv"):
        row = row["pbrMetallicRoughness"]
    if where == "uv":
        extensions = row["baseColorTexture"].setdefault("extensions", {})
        row = extensions.setdefault("KHR_texture_transform", {})
    elif where not in ("metal", ""):
        row = row.setdefault("extensions", {}).setdefault(f"KHR_materials_{where}", {})
    row[name] = value
    return look_at_parts(write_glb(folder / "a.glb", tree, buffer))


def obj(folder: Path, where: str, name: str, value: Any) -> str:
    line = f"map_Kd {name} {value} its picture.png" if where == "option" else f"{name} {value}"
    return look_at_parts(kit.textured_obj(folder / "o" / "a.obj", SMALL_PICTURE, f"{line}\n"))


def usd(folder: Path, where: str, name: str, value: Any) -> str:
    def change(stage: Any) -> None:
        kit.set_inputs(stage, where, {name: tuple(value) if isinstance(value, list) else value})

    path, connect = folder / "u" / "a.usda", {"emissiveColor": "rgb"}
    return look_at_parts(kit.textured_usd(path, SMALL_PICTURE, change, connect=connect))


def scene(folder: Path, where: str, name: str, value: Any) -> str:
    fields = MATERIAL if where == "material" else TRANSFORM
    read_renderformer_json(changed(*fields, **{name: value}), f"{name}.json")
    return ""


def radiance(folder: Path, where: str, name: str, value: Any) -> str:
    head = f"#?RADIANCE\n{name}={value}\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 1\n"
    picture = read_linear_picture(head.encode() + bytes([128] * 4), 1)
    assert picture is not None and np.isfinite(picture.values).all()
    return ""


FIELDS = [
    *((gltf, "metal", "baseColorFactor", 4), (gltf, "metal", "metallicFactor", 1)),
    *((gltf, "metal", "roughnessFactor", 1), (gltf, "ior", "ior", 1)),
    *((gltf, "specular", "specularFactor", 1), (gltf, "specular", "specularColorFactor", 3)),
    *((gltf, "", "emissiveFactor", 3), (gltf, "emissive_strength", "emissiveStrength", 1)),
    *((gltf, "uv", "rotation", 1), (gltf, "uv", "scale", 2), (gltf, "uv", "offset", 2)),
    *((obj, "", name, 1) for name in ("Kd", "Ks", "Ns", "Ke", "Pm", "Pr", "illum")),
    *((obj, "option", name, 1) for name in ("-s", "-o")),
    *((usd, kit.SHADER, name, 1) for name in ("roughness", "metallic", "ior")),
    *(
        (usd, kit.SHADER, "diffuseColor", 3),
        (usd, kit.TEXTURE, "scale", 4),
        (usd, kit.TEXTURE, "bias", 4),
    ),
    *((scene, "material", "roughness", 1), (scene, "material", "emissive", 3)),
    *((scene, "transform", "scale", 3), (radiance, "", "EXPOSURE", 1)),
]


def test_a_number_that_is_not_finite_is_named_by_its_field(tmp_path: Path) -> None:
    for (read, where, name, count), number in itertools.product(FIELDS, NUMBERS):
        with case((read.__name__, where, name, number)):
            try:
                said = read(tmp_path, where, name, number if count == 1 else [number] * count)
            except (Rejected, TrilightError) as refusal:
                said = str(refusal)
            if not FINITE.holds(number):
                assert name.lower() in said.lower() or "no JSON number" in said
