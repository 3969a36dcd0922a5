"""glTF in its dialects: what an object and a scene of one file have is what its text says."""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.assets.settings import OwnMaterialSettings
from pipeline.assets.source_materials.skin import _parts
from pipeline.exchange.gltf import read_gltf
from pipeline.exchange.textured_triangles import LoadedScene
from pipeline.foreign.limits import ReadLimits
from pipeline.foreign.material import SourceMaterial, source_columns
from pipeline.foreign.picture import FilePictures
from pipeline.foreign.source_file import load_mesh, read_source
from storage.errors import Rejected, TrilightError
from storage.records.lookup import textured_rows
from tests.for_each import case, for_each
from tests.pipeline.assets.meshes_by_hand import gltf_tree
from tests.pipeline.assets.source_materials.textured_kit import SQUARE
from tests.pipeline.foreign.gltf.gltf_writer import GltfWriter, matrix_of

KEPT = ReadLimits(with_materials=True)
Y_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.float64)
HALF = 0.5**0.5


def surface(path: Path) -> NDArray[np.float64]:
    """Return corners and diffuse color [T, 12] of an object's triangles that have an area."""
    source = read_source(path, KEPT)
    try:
        parts = _parts(source, FilePictures(1 << 26), OwnMaterialSettings())
    except Rejected as why:
        assert why.reason == "no_materials"
        corners = load_mesh(source).corners
        return ordered(corners, np.zeros((len(corners), 3)))  # the default of glTF is a metal
    corners = parts.mesh.positions[parts.mesh.faces]
    assert np.array_equal(load_mesh(source).corners, corners)
    colors = np.zeros((len(corners), 3))
    for row in np.unique(parts.material):
        chosen = np.flatnonzero(parts.material == row)
        material: SourceMaterial = parts.materials[row]
        base = np.ones((len(chosen), 4), np.float32)
        if (slot := material.base) is not None:
            uv = parts.uv[chosen, slot.uv_set].mean(axis=1) @ slot.uv_matrix.T + slot.uv_offset
            base = slot.picture.sample(uv, np.zeros(len(chosen), np.int64))
        if parts.color is not None:
            base[:, :3] *= parts.color[chosen].mean(axis=1)
        colors[chosen] = source_columns(material, {"base": base}, len(chosen))[:, :3]
    return ordered(corners, colors)


def scene_surface(found: LoadedScene) -> NDArray[np.float64]:
    """Return the same of a scene."""
    scene = found.scene
    corners = scene.vertex_positions[scene.faces].astype(np.float64)
    uv = np.zeros((len(corners), 3, 2)) if scene.uv is None else scene.uv.reshape(-1, 3, 2)
    rows = textured_rows(scene, scene.material_index, uv.mean(axis=1)).astype(np.float64)
    return ordered(corners, rows[:, :3])


def ordered(corners: NDArray[np.float64], colors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rows that are equal for equal surfaces: each begins at its first corner."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    kept = np.linalg.norm(cross, axis=1) > 1e-6
    coarse = np.round(corners[kept] * 64).astype(np.int64)
    first = (coarse @ np.array([1 << 40, 1 << 20, 1])).argmin(axis=1)
    turn = (first[:, None] + np.arange(3)) % 3
    turned = np.take_along_axis(corners[kept], turn[..., None], axis=1)
    keys = np.take_along_axis(coarse, turn[..., None], axis=1).reshape(-1, 9)
    rows = np.concatenate([turned.reshape(-1, 9), colors[kept]], axis=1)
    return rows[np.lexsort(np.column_stack([keys, np.round(colors[kept] * 8)]).T[::-1])]


QUATERNIONS = [(0, 0, 0, 1), (0, 0, HALF, HALF), (0.5, 0.5, 0.5, 0.5), (0, 1, 0, 0)]
MODELS = ["", "KHR_materials_unlit", "KHR_materials_pbrSpecularGlossiness"]
numbers = st.integers(-40, 40)


@st.composite
def placements(draw: st.DrawFn) -> tuple[dict[str, Any], NDArray[np.float64]]:
    """Draw a node's place, as TRS or as a matrix; mirrored ones too."""
    translation = [draw(numbers) / 4 for _ in range(3)]
    rotation = list(draw(st.sampled_from(QUATERNIONS)))
    scale = [draw(st.sampled_from([1, 2, -1, 0.5])) for _ in range(3)]
    matrix = matrix_of(translation, rotation, scale)
    if draw(st.booleans()):
        return {"matrix": matrix.T.ravel().tolist()}, matrix
    return {"translation": translation, "rotation": rotation, "scale": scale}, matrix


@st.composite
def dialects(draw: st.DrawFn) -> dict[str, Any]:
    count = 3 * draw(st.integers(1, 4))
    positions = np.array(draw(st.lists(numbers, min_size=3 * count, max_size=3 * count)))
    mode = draw(st.sampled_from([None, 4, 5, 6]))
    more = [draw(st.integers(0, count - 1)) for _ in range(3 * draw(st.integers(1, 5)))]
    return {
        "positions": positions.reshape(-1, 3),
        "code": draw(st.sampled_from(["f4", "i2", "i1", "unit"])),
        "layout": draw(st.sampled_from(["plain", "strided", "sparse", "zeros"])),
        "mode": mode,
        "order": draw(st.sampled_from([None, more])),
        "indices": draw(st.sampled_from(["u1", "u2", "u4"])),
        "colors": draw(st.sampled_from([None, "f4", "u1", "u2"])),
        "alpha": draw(st.booleans()),
        "color layout": draw(st.sampled_from(["plain", "strided", "sparse", "zeros"])),
        "flat": draw(st.booleans()),
        "model": draw(st.sampled_from(MODELS)),
        "places": draw(st.lists(placements(), min_size=1, max_size=3)),
        "instances": draw(st.sampled_from([None, "f4", "i1"])),
        "beside": draw(st.sampled_from([None, "camera", "light"])),
        "scenes": draw(st.sampled_from(["first", "default", "none"])),
        "form": draw(st.sampled_from(["glb", "glb with chunks", "data", "bin"])),
    }


def written(dialect: dict[str, Any], folder: Path) -> tuple[Path, NDArray[np.float64]]:
    """Write a mesh in a dialect; return its file and what must be read of it."""
    file = GltfWriter()
    stored, is_unit = dialect["positions"], dialect["code"] == "unit"
    code, points = "i1" if is_unit else dialect["code"], stored / (127 if is_unit else 1)
    place = file.accessor(stored, code, layout=dialect["layout"], normalized=is_unit)
    attributes = {"POSITION": place}
    if code != "f4":
        file.use("KHR_mesh_quantization")
    colors = with_colors(file, dialect, attributes)
    order = np.arange(len(points)) if dialect["order"] is None else np.array(dialect["order"])
    primitive: dict[str, Any] = {"attributes": attributes, "material": 0}
    if dialect["order"] is not None:
        primitive["indices"] = file.accessor(order, dialect["indices"])
    if dialect["mode"] is not None:
        primitive["mode"] = dialect["mode"]
    base = np.array([0.5, 0.25, 1])
    metal = {"metallicFactor": 0, "baseColorFactor": [*base, 1]}
    glossy = {"diffuseFactor": [*base, 1], "specularFactor": [0, 0, 0]}
    more = {"KHR_materials_unlit": {}, "KHR_materials_pbrSpecularGlossiness": glossy}
    model = {name: each for name, each in more.items() if name == dialect["model"]}
    file.add("materials", {"pbrMetallicRoughness": metal, "extensions": model})
    file.add("meshes", {"primitives": [primitive]})
    diffuse = base * (1 if model else 1 - 0.04 - 0.96 / 21)
    corners, shades = [], []
    triangles = spans(order.tolist(), dialect["mode"] or 4)
    for matrix, three in itertools.product(with_nodes(file, dialect), triangles):
        at = points[three] @ matrix[:3, :3].T + matrix[:3, 3]
        corners.append((at[::-1] if np.linalg.det(matrix[:3, :3]) < 0 else at) @ Y_UP.T)
        shades.append(colors[three].mean(axis=0) * diffuse)
    wanted = ordered(np.reshape(corners, (-1, 3, 3)), np.reshape(shades, (-1, 3)))
    return file.save(folder, dialect["form"]), wanted


def with_colors(
    file: GltfWriter, dialect: dict[str, Any], attributes: dict[str, int]
) -> NDArray[np.float64]:
    count, code = len(dialect["positions"]), dialect["colors"]
    if code is None:
        return np.ones((count, 3))
    most = {"f4": 1, "u1": 255, "u2": 65535}[code]
    rows = np.random.default_rng(count).integers(0, 3, (1 if dialect["flat"] else count, 3)) / 2
    stored = np.tile(np.floor(rows * most) if most > 1 else rows, (count // len(rows), 1))
    whole = np.column_stack([stored, np.full(count, most)]) if dialect["alpha"] else stored
    layout = dialect["color layout"]
    attributes["COLOR_0"] = file.accessor(whole, code, layout=layout, normalized=most > 1)
    return stored / most


def with_nodes(file: GltfWriter, dialect: dict[str, Any]) -> list[NDArray[np.float64]]:
    """Add a chain of nodes with the mesh on the last one; return where it is placed."""
    place = np.eye(4)
    for row, (stated, matrix) in enumerate(dialect["places"]):
        file.add("nodes", {**stated, "children": [row + 1]})
        place = place @ matrix
    last = file.tree["nodes"][-1]
    del last["children"]
    last |= {"mesh": 0, "extensions": {}}
    if dialect["beside"] == "camera":
        file.add("cameras", {"type": "perspective", "perspective": {"yfov": 1, "znear": 0.1}})
        last["camera"] = 0
    elif dialect["beside"] == "light":
        lights = {"lights": [{"type": "point", "intensity": 0}]}
        file.tree["extensions"] = {"KHR_lights_punctual": lights}
        last["extensions"]["KHR_lights_punctual"] = {"light": 0}
    if dialect["scenes"] != "none":
        file.tree["scenes"] = [{"nodes": [0]}]
    if dialect["scenes"] == "default":
        file.tree["scenes"].insert(0, {"nodes": []})
        file.tree["scene"] = 1
    code = dialect["instances"]
    if code is None:
        return [place]
    moves, turns = np.array([[0, 0, 0], [8, 1, 0]], np.float64), np.array(QUATERNIONS[1:3])
    turns = np.round(turns * 127) if code == "i1" else turns
    last["extensions"]["EXT_mesh_gpu_instancing"] = {
        "attributes": {
            "TRANSLATION": file.accessor(moves, "f4"),
            "ROTATION": file.accessor(turns, code, normalized=code == "i1"),
        }
    }
    units = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    return [place @ matrix_of(*pair, (1, 1, 1)) for pair in zip(moves, units, strict=True)]


def spans(order: list[int], mode: int) -> list[list[int]]:
    """Return the triangles of a list, a strip or a fan, as the text of glTF has them."""
    if mode == 4:
        return [order[i : i + 3] for i in range(0, len(order), 3)]
    if mode == 5:
        rows = range(len(order) - 2)
        return [[order[i], order[i + 1 + i % 2], order[i + 2 - i % 2]] for i in rows]
    return [[order[i + 1], order[i + 2], order[0]] for i in range(len(order) - 2)]


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(dialect=dialects())
def test_an_object_and_a_scene_are_what_the_file_says(
    dialect: dict[str, Any], tmp_path: Path
) -> None:
    path, wanted = written(dialect, tmp_path)
    unread = ("1 of 2 scenes: the default one is read",)
    assert read_source(path, KEPT).unread == (unread if dialect["scenes"] == "default" else ())
    found = surface(path)
    assert found.shape == wanted.shape
    np.testing.assert_allclose(found, wanted, atol=2e-3)
    if len(wanted):
        np.testing.assert_allclose(scene_surface(read_gltf(path)), wanted, atol=2e-3)


def test_many_colors_of_vertices_are_a_texture_of_a_scene(tmp_path: Path) -> None:
    file, rng = GltfWriter(), np.random.default_rng(0)
    points, colors = rng.random((3000, 3)) * 8, np.repeat(rng.random((1000, 3)), 3, axis=0)
    names = {"POSITION": points, "COLOR_0": colors}
    attributes = {name: file.accessor(values, "f4") for name, values in names.items()}
    file.add("meshes", {"primitives": [{"attributes": attributes, "material": 0}]})
    file.add("materials", {"pbrMetallicRoughness": {"metallicFactor": 0}})
    file.add("nodes", {"mesh": 0})
    path = file.save(tmp_path, "glb")
    scene = read_gltf(path)
    assert len(scene.scene.textures) == 1
    np.testing.assert_allclose(scene_surface(scene), surface(path), atol=0.01)


def assert_same_surfaces(path: Path) -> None:
    with case(path.name):
        seen = scene_surface(read_gltf(path))
        np.testing.assert_allclose(seen, surface(path), atol=0.02)


def test_objects_and_scenes_of_the_cases_are_the_same(shared: Path) -> None:
    for path in (shared / "cases").glob("*/in/*.gl[bt]*"):
        assert_same_surfaces(path)


@pytest.mark.slow("references")
def test_objects_and_scenes_of_shared_files_are_the_same(shared: Path) -> None:
    """Every eighth: all of them passed when the reader was written, in two minutes."""
    for path in sorted((shared / "objects").rglob("*.gl[bt]*"))[::8]:
        assert_same_surfaces(path)


def plain(change: Callable[[GltfWriter], Any] = lambda file: None) -> GltfWriter:
    """Return a square of two triangles, changed."""
    tree, buffer = gltf_tree(SQUARE)
    file = GltfWriter(tree=tree, data=bytearray(buffer))
    change(file)
    return file


def _set(path: str, value: Any) -> Callable[[GltfWriter], None]:
    """Return what sets an entry of a tree by its path."""

    def change(file: GltfWriter) -> None:
        *above, last = [int(word) if word.isdigit() else word for word in path.split("/")]
        row: Any = file.tree
        for word in above:
            row = row[word]
        row[last] = value

    return change


PRIMITIVE = "meshes/0/primitives/0"
NOTHING = {"componentType": 5126, "type": "VEC3"}
HIDDEN = {"KHR_node_visibility": {"visible": False}}
BEYOND = {"bufferView": 0, "byteOffset": 14, "componentType": 5121}
SPARSE = {"count": 2, "indices": BEYOND, "values": {"bufferView": 0}}
REFUSED: dict[str, tuple[str, Callable[[GltfWriter], None]]] = {
    "a later version": ("unsupported_format", _set("asset/minVersion", "2.1")),
    "an older version": ("unsupported_format", _set("asset/version", "1.0")),
    "an unknown mode": ("unsupported_primitive", _set(f"{PRIMITIVE}/mode", 7)),
    "a mesh without primitives": ("load_error", _set("meshes/0", {})),
    "a node that is no object": ("load_error", _set("nodes/0", [])),
    "a view beyond its buffer": ("load_error", _set("bufferViews/0/byteLength", 1 << 30)),
    "half a triangle": ("load_error", _set("accessors/1/count", 5)),
    "an index that counts from the end": ("load_error", _set("nodes/0/mesh", -1)),
    "doubles": ("unsupported_accessor", _set("accessors/0/componentType", 5130)),
    "a sparse value beyond": ("load_error", _set("accessors/0/sparse", SPARSE)),
    "a hidden mesh": ("no_faces", _set("nodes/0/extensions", HIDDEN)),
    "a bomb of nothing": ("too_many_faces", _set("accessors/0", {**NOTHING, "count": 1 << 40})),
}


@for_each("name", REFUSED)
def test_what_is_refused(tmp_path: Path, name: str) -> None:
    reason, change = REFUSED[name]
    path = plain(change).save(tmp_path, "bin")
    with pytest.raises(Rejected) as refusal:
        load_mesh(read_source(path, KEPT))
    assert refusal.value.reason == reason
    with pytest.raises(TrilightError):
        read_gltf(path)


@for_each("keep", [4, 11, 30, 0.5, 0.97, -1])
def test_files_that_end_early_are_cut_off(tmp_path: Path, keep: float) -> None:
    for form in ("glb", "data"):
        path = plain().save(tmp_path, form)
        data = path.read_bytes().rstrip()
        path.write_bytes(data[: int(keep * len(data)) if 0 < keep < 1 else int(keep)])
        with pytest.raises(Rejected, match="cut_off"):
            read_source(path, KEPT)
    path, buffer = plain().save(tmp_path, "bin"), tmp_path / "some name.bin"
    buffer.write_bytes(buffer.read_bytes()[:-16])
    with pytest.raises(Rejected, match="cut_off"):
        load_mesh(read_source(path, KEPT))


UNREAD: dict[str, Callable[[GltfWriter], None]] = {
    "extension 'EXT_lights_image_based' of scenes": _set(
        "scenes/0/extensions", {"EXT_lights_image_based": {"light": 0}}
    ),
    "extension 'KHR_materials_variants' of primitives": _set(
        f"{PRIMITIVE}/extensions", {"KHR_materials_variants": {"mappings": []}}
    ),
    "extension 'KHR_materials_volume' of materials": _set(
        "materials", [{"extensions": {"KHR_materials_volume": {}}}]
    ),
    "extension 'OTHER_thing' of the file": _set("extensionsUsed", ["OTHER_thing"]),
    "data of other programs (extras) of nodes": _set("nodes/0/extras", {"children": [7]}),
    "key 'instances' of nodes": _set("nodes/0/instances", 3),
    "attribute '_WIND' of primitives": _set(f"{PRIMITIVE}/attributes/_WIND", 0),
    "attribute 'COLOR_1' of primitives": _set(f"{PRIMITIVE}/attributes/COLOR_1", 0),
    "attribute '_COLOR_0' of nodes, EXT_mesh_gpu_instancing": _set(
        "nodes/0/extensions", {"EXT_mesh_gpu_instancing": {"attributes": {"_COLOR_0": 1}}}
    ),
    "animations: everything stands as it does without them": _set("animations", [{}]),
    "": _set("extensionsUsed", ["KHR_xmp_json_ld", "KHR_draco_mesh_compression"]),
}


@for_each("sentence", UNREAD)
def test_what_no_code_reads_is_named_once(tmp_path: Path, sentence: str) -> None:
    path = plain(UNREAD[sentence]).save(tmp_path, "glb")
    source = read_source(path, KEPT)
    assert source.unread == ((sentence,) if sentence else ())
    assert set(source.unread) <= set(read_gltf(path).notes)
    assert len(load_mesh(source).faces) == (12 if "instancing" in sentence else 2)


def test_targets_shape_a_mesh_by_its_weights(tmp_path: Path) -> None:
    def shape(file: GltfWriter) -> None:
        moves = np.array([[0, 0, 4]] * 4), np.array([[8, 0, 0]] * 4)
        targets = [{"POSITION": file.accessor(move, "f4", layout="zeros")} for move in moves]
        file.tree["meshes"][0]["primitives"][0]["targets"] = targets
        file.tree["meshes"][0]["weights"] = [9, 9]
        file.tree["nodes"][0]["weights"] = [0.5, 0]

    path = plain(shape).save(tmp_path, "glb")
    assert load_mesh(read_source(path, KEPT)).positions[:, 1].tolist() == [-2] * 4
