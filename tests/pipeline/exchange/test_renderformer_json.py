"""RenderFormer's JSON: what is read, what is refused with file, field, got and expected, and a
scene written and read again: the same triangles in the same light."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from pipeline.exchange.from_description import scaled_albedo_notes
from pipeline.exchange.renderformer_json import (
    MAX_BYTES,
    read_renderformer_json,
    write_renderformer_json,
)
from storage.errors import TrilightError
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS, SPECULAR
from storage.records.scene import SceneObject
from tests.for_each import case, for_each
from tests.pipeline.exchange.exchange_kit import assert_json_keeps_light, json_and_back
from tests.pipeline.scenes.example_scenes import (
    BOX,
    CAMERA,
    EXAMPLES,
    MATERIAL,
    OBJECT,
    SCENE,
    TRANSFORM,
    built,
    changed,
    corners_of,
    described,
    example_scene,
    loaded,
    plain_obj,
)
from tests.scenes_by_hand import LIGHT, tiny_scene


def test_what_may_be_missing_has_the_published_default() -> None:
    scene = json.loads(changed())
    del scene["objects"]["box"]["transform"]["normalize"]
    for name in ("rand_tri_diffuse_seed", "random_diffuse_max", "random_diffuse_type"):
        del scene["objects"]["box"]["material"][name]
    (box,) = read_renderformer_json(json.dumps(scene).encode(), "a.json").objects.values()
    assert box.transform.normalize
    assert box.material.rand_tri_diffuse_seed is None
    assert box.material.random_diffuse_max == 1
    assert box.material.random_diffuse_type == "per-shading-group"
    assert (box.remesh, box.remesh_target_face_num) == (False, 2048)
    data = changed(*MATERIAL, rand_tri_diffuse_seed=0)
    (box,) = read_renderformer_json(data, "a.json").objects.values()
    assert box.material.rand_tri_diffuse_seed == 0


def test_unknown_fields_are_named_and_harmless_and_a_file_needs_no_name_in_utf_8() -> None:
    assert read_renderformer_json(changed(), "\udcff.json").file == "\udcff.json"
    scene = json.loads(changed())
    scene["environment"] = {}
    scene["objects"]["box"]["material"]["ruoghness"] = 1
    scene["objects"]["box"]["transform"]["line\nbreak"] = 1
    scene["cameras"][0]["near"] = 0.1
    described = read_renderformer_json(json.dumps(scene).encode(), "a.json")
    unknown = {"environment", "cameras[0].near", "objects.box.material.ruoghness"}
    unknown.add(repr("objects.box.transform.line\nbreak"))
    assert sorted(described.unknown_fields) == sorted(unknown)
    assert described.objects == read_renderformer_json(changed(), "a.json").objects


REFUSED = [
    (changed(version="2.0"), "version is '2.0'; expected 1.0"),
    (changed(objects={str(i): 1 for i in range(8193)}), "8193 objects; expected 1 to 8192"),
    (changed(objects=[]), "0 objects; expected 1 to 8192"),
    (changed(objects={"a": 1}), "objects.a is 1; expected names with values"),
    # the second name is what a message calls the first
    (changed(objects={"a\n": OBJECT, repr("a\n"): OBJECT}), "is 'a\\n'; expected a printable name"),
    (changed(cameras=[]), "0 cameras; expected 1 to 1000"),
    (changed(scene_name=...), "scene_name is missing; expected printable"),
    (changed(*BOX, mesh_path="a\0b"), "objects.box.mesh_path is 'a\\x00b'; expected printable"),
    (changed(*BOX, mesh_path="\ud800"), "all of it is not JSON (unexpected end"),
    (
        changed(*BOX, mesh_path=...)[:-1] + b"," + b'"a":' + b"[" * 300 + b"]" * 300 + b"}",
        "missing",
    ),
    (
        changed().replace(b'"box.obj"', b"[" * 900 + b"]" * 900),
        "all of it is not JSON (recursion",
    ),
    (changed(*BOX, remesh_target_face_num=2), "is 2; expected a whole number from 4"),
    (changed(*TRANSFORM, normalize="yes"), "normalize is 'yes'; expected true or false"),
    (changed(*TRANSFORM, scale=2), "objects.box.transform.scale is 2; expected three numbers"),
    (
        changed(*TRANSFORM, translation=[1e9, 0, 0]),
        "translation is [1000000000.0, 0, 0]; expected three",
    ),
    (changed(*TRANSFORM, translation=[10**400, 0, 0]), "translation is [1000000"),
    (
        changed(*MATERIAL, diffuse=[0.5, 0.5, 1.5]),
        "[0.5, 0.5, 1.5]; expected three numbers from 0 to 1",
    ),
    (changed(*MATERIAL, diffuse=[True, 0, 0]), "diffuse.0 is True; expected three numbers"),
    (changed(*MATERIAL, random_diffuse_type="x"), "is 'x'; expected per-triangle or per-shading"),
    (changed(*MATERIAL, rand_tri_diffuse_seed=1.5), "is 1.5; expected a whole number"),
    (changed().replace(b"40", b"1e999"), "cameras.0.fov is inf; expected a number"),
    (changed(*TRANSFORM, rotation=[1, 2]), "rotation.2 is missing; expected three numbers"),
    (changed(*TRANSFORM, scale=[None, 1, 1]), "scale.0 is None; expected three numbers"),
    (
        changed(*MATERIAL, emissive=[-1, 0, 0]),
        "emissive is [-1, 0, 0]; expected three numbers from 0",
    ),
    (changed(*CAMERA, fov=180), "cameras.0.fov is 180; expected a number from 0.001 to 179"),
    (changed(cameras=[{}] * 1001), "1001 cameras; expected 1 to 1000"),
    (b"", "not readable as JSON"),
    ('{"a": 1}'.encode("utf-16"), "not readable as JSON in UTF-8"),
    (b'{"a":' * 100_000, "a.json: "),
    (b"[" * 100_000, "a.json: "),
    (b"[]", "the file is []; expected a JSON object"),
    (b"null", "the file is None; expected a JSON object"),
    (b'{"a": NaN}', "NaN is no JSON number"),
    (b'{"a": 1' + b"0" * 5000 + b"}", "not readable as JSON"),
    (b'{"a": 1, "a": 2}', "the name 'a' stands twice"),
    (b" " * (MAX_BYTES + 1), "4194305 bytes; expected at most 4194304"),
]


@for_each("data, message", REFUSED)
def test_what_is_wrong_is_named(data: bytes, message: str) -> None:
    with pytest.raises(TrilightError) as caught:
        read_renderformer_json(data, "a.json")
    assert message in str(caught.value)
    assert str(caught.value).startswith("a.json: ")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400  # however long the value is


def test_every_field_is_looked_at() -> None:
    """No field of the example may be turned into nonsense, or left out, without a complaint."""
    optional = {"normalize", "rand_tri_diffuse_seed", "random_diffuse_max", "random_diffuse_type"}

    def visit(path: tuple[str | int, ...], node: Any) -> None:
        for name in list(node):
            if isinstance(node[name], dict):
                visit((*path, name), node[name])
            for wrong in ({"x": "y"},) if name in optional else ({"x": "y"}, ...):
                with pytest.raises(TrilightError):
                    read_renderformer_json(changed(*path, **{name: wrong}), "a.json")

    visit((), {name: value for name, value in SCENE.items() if name != "objects"})
    visit(BOX, OBJECT)
    visit(CAMERA, SCENE["cameras"][0])  # type: ignore[index]


def test_a_scene_by_hand_comes_back_but_for_normals_that_no_reader_makes(tmp_path: Path) -> None:
    scene = tiny_scene()
    back, lost = json_and_back(scene, tmp_path)
    assert_json_keeps_light(back, scene)
    assert np.array_equal(back.vertex_normals[back.faces], scene.vertex_normals[scene.faces])
    assert [(o.name, o.kind) for o in back.objects] == [("floor", "shell"), ("light", "emitter")]
    assert lost == ()
    described = json.loads((tmp_path / "again.json").read_text())
    assert described["objects"]["floor"]["mesh_path"].startswith("templates/backgrounds/")
    scene.vertex_normals[0] = [0.6, 0, 0.8]
    _, lost = json_and_back(scene, tmp_path)
    assert "floor: shading normals, which readers compute again" in lost


def test_an_object_of_many_colours_and_odd_names(tmp_path: Path) -> None:
    base = tiny_scene()
    scene = dataclasses.replace(
        base,
        materials=np.concatenate([base.materials, base.materials[:1] / 2]),
        material_index=np.array([0, 2, LIGHT], np.uint16),
        objects=(
            SceneObject(name="a/..\n\0ü", kind="object", uid="u"),
            SceneObject(name="light", kind="emitter"),
        ),
    )
    back, lost = json_and_back(scene, tmp_path)
    assert_json_keeps_light(back, scene)
    assert [entry.name for entry in back.objects] == [
        "a_..__ü.material0", "a_..__ü.material2", "light",
    ]  # fmt: skip
    assert lost == ("the grouping of 2 objects that were 1, of several materials",)
    written = [path.relative_to(tmp_path).parts[0] for path in tmp_path.rglob("*.obj")]
    assert set(written) == {"objects"}


def test_too_much_light_and_too_many_objects(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bright = tiny_scene()
    bright.materials[LIGHT, 7:] = 65505
    assert any("cuts off" in text for text in write_renderformer_json(tmp_path / "a.json", bright))
    monkeypatch.setattr("pipeline.exchange.renderformer_json.MAX_OBJECTS", 1)
    with pytest.raises(TrilightError, match="2 objects of one material; expected at most 1"):
        write_renderformer_json(tmp_path / "a.json", tiny_scene())


def _placed(points: NDArray[np.float64], transform: dict[str, Any]) -> NDArray[np.float64]:
    """Place points [N, 3] by the rotations of another library."""
    if transform["normalize"]:
        centred = points - points.mean(axis=0)
        points = centred / np.linalg.norm(centred, axis=1).max() / 2
    turn = Rotation.from_euler("xyz", transform["rotation"], degrees=True)
    return np.asarray(turn.apply(points) * transform["scale"] + transform["translation"])


@for_each("name", EXAMPLES)
def test_examples_have_the_places_materials_and_kinds_of_their_files_and_no_unknown_field(
    shared: Path, name: str
) -> None:
    """Every corner is where a twin puts it."""
    data = (shared / "renderformer_scenes" / f"{name}.json").read_bytes()
    described, objects = read_renderformer_json(data, name), json.loads(data)["objects"]
    assert described.unknown_fields == ()
    assert list(described.objects) == list(objects)
    assert len(described.cameras) == 1
    scene = example_scene(shared, name)
    assert scene.num_triangles == EXAMPLES[name]
    for row, (key, stated) in enumerate(objects.items()):
        points, triangles = plain_obj(shared / "renderformer_scenes" / stated["mesh_path"])
        expected, found = _placed(points, stated["transform"])[triangles], corners_of(scene, row)
        assert len(found) == len(triangles)
        if "compose/obj0" in stated["mesh_path"] or "compose/obj1" in stated["mesh_path"]:
            # quads: the loader puts their halves elsewhere, so that only the points are compared
            everything = KDTree(found.reshape(-1, 3))
            assert everything.query(expected.reshape(-1, 3))[0].max() < 1e-6
        else:
            # float32 rounds coordinates of up to 2.2 by up to 1.2e-7; the sums of the vertex mean,
            # in another order, by less
            np.testing.assert_allclose(found, expected, atol=3e-7)
        rows = np.unique(scene.material_index[scene.object_index == row])
        material, entry = stated["material"], scene.objects[row]
        assert (entry.name, entry.licence) == (key, "LicenseRef-user-provided")
        emits = max(material["emissive"]) > 0
        kind = "shell" if "backgrounds" in stated["mesh_path"] else "object"
        assert entry.kind == ("emitter" if emits else kind)
        same = [(SPECULAR, "specular"), (ROUGHNESS, "roughness"), (EMISSION, "emissive")]
        if emits or material.get("rand_tri_diffuse_seed") is None:
            assert len(rows) == 1
            same.append((DIFFUSE, "diffuse"))
        for part, field in same:
            values = scene.materials[rows][:, part]
            np.testing.assert_allclose(values, np.zeros_like(values) + material[field], rtol=1e-6)


def test_a_mirroring_scale_keeps_the_outside_outside() -> None:
    description = described(*TRANSFORM, scale=[-1, 1, 1], translation=[0, 0, 0])
    corners = corners_of(built(description), 0).astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.sum(normals * corners.mean(axis=1), axis=1) > 0).all()


def test_every_triangle_of_an_emitter_is_an_emitter_whose_name_may_not_meet_another() -> None:
    description, lit = described(), loaded(trimesh.creation.box(), "light.obj")
    scene = built(description, light=lit)
    emitters = [entry for entry in scene.objects if entry.kind == "emitter"]
    assert [entry.name for entry in emitters] == [f"light.{row}" for row in range(12)]
    assert scene.triangle_emits.sum() == 12
    rows = scene.materials[scene.material_index[scene.triangle_emits]]
    # It reflects what its file says, too.
    expected = [0.5, 0.4, 0.3, 0.1, 0.1, 0.1, 0.3, 10, 5, 0]
    np.testing.assert_allclose(rows, np.broadcast_to(expected, rows.shape), rtol=1e-6)
    np.testing.assert_array_equal(np.bincount(scene.object_index), [12, *[1] * 12])
    box, light = description.objects.values()
    renamed = {"box": dataclasses.replace(box, name="light.0"), "light": light}
    with pytest.raises(TrilightError, match="'light.0' twice"):
        built(dataclasses.replace(description, objects=renamed), light=lit)


def test_shells_are_told_by_their_folder() -> None:
    box = trimesh.creation.box()
    inside = built(described(), loaded(box, "templates/backgrounds/plane.obj"))
    assert (inside.objects[0].kind, inside.objects[0].uid) == ("shell", "")
    name = "templates/backgrounds.obj"
    beside = built(described(), loaded(box, name)).objects[0]
    assert (beside.kind, beside.uid) == ("object", name)


def test_smooth_shading_stops_where_the_file_splits_its_vertices() -> None:
    ball = trimesh.creation.icosphere(2)
    corners = ball.triangles.reshape(-1, 3)
    split = trimesh.Trimesh(corners, np.arange(960).reshape(-1, 3), process=False)
    description = described(*TRANSFORM, scale=[1, 1, 1])
    for mesh, is_smooth in ((ball, True), (split, False)):
        scene = built(description, loaded(mesh))
        corner_normals = scene.vertex_normals[scene.faces[scene.object_index == 0]]
        assert bool((corner_normals.std(axis=1).max(axis=1) > 0.01).all()) is is_smooth


MEANINGLESS: list[tuple[tuple[str | int, ...], dict[str, Any], str]] = [
    (MATERIAL, {"specular": [0, 0, 0.8]}, "objects.box: diffuse + specular is 1.1000; expected at"),
    (
        MATERIAL,
        {"rand_tri_diffuse_seed": 1, "random_diffuse_max": 1.0, "specular": [0.5] * 3},
        "objects.box: diffuse + specular is 1.5",
    ),
    (
        MATERIAL,
        {"specular": [0.8] * 3, "emissive": [1.0] * 3},
        "objects.box: diffuse + specular is 1.3",
    ),
    (TRANSFORM, {"scale": [0, 1, 0]}, "objects.box: no triangle of box.obj has an area"),
    (CAMERA, {"look_at": [0, -2, 0]}, "cameras[0] looks from (0.0, -2.0, 0.0) at"),
    (CAMERA, {"up": [0, 3, 0]}, "and an up that is not along the view"),
    # along the view but for 1e-16, of which a camera with an arbitrary roll was made
    (CAMERA, {"up": [0.3, 0.6, 0.9], "position": [0.1, 0.2, 0.3], "look_at": [0, 0, 0]}, "along"),
    (CAMERA, {"up": [0, 0, 0]}, "cameras[0] looks from"),
]


def test_what_means_nothing_is_refused_by_name() -> None:
    for path, change, message in MEANINGLESS:
        with case(change), pytest.raises(TrilightError) as caught:
            built(described(*path, **change), albedo_over_one="refuse")
        assert str(caught.value).startswith("a.json: ")
        assert message in str(caught.value)


@pytest.mark.parametrize("emissive", [[0.0] * 3, [1.0] * 3])
def test_of_random_colours_only_those_beyond_one_are_scaled(emissive: list[float]) -> None:
    """Each by its own factor, so that hue and gloss beside colour stay; the others are untouched.

    An emitter has one colour, that of its file."""
    lit = any(emissive)
    colours = {"diffuse": [0.9, 0.6, 0.3]} if lit else {"rand_tri_diffuse_seed": 1}
    change = {"specular": [0.25, 0.2, 0.15], "random_diffuse_max": 1.0, "emissive": emissive}
    lawful = built(described(*MATERIAL, **{**change, **colours}))
    plain = built(described(*MATERIAL, **{**change, **colours, "specular": [0.0] * 3}))
    specular = np.array([0.25, 0.2, 0.15])
    box = lawful.material_index[:12]
    factors = set()
    for row, before in zip(lawful.materials[box], plain.materials[box], strict=True):
        diffuse = before[:3].astype(np.float64)
        factor = min(1.0, 1 / float((diffuse + specular).max()))
        expected = np.concatenate([factor * diffuse, factor * specular])
        assert row[:6] == pytest.approx(expected, rel=1e-6)  # the rounding of float32
        factors.add(factor)
    assert min(factors) < 1
    assert lit or max(factors) == 1
    assert lawful.provenance["albedo_scale"] == {"box": round(min(factors), 6)}
    (note,) = scaled_albedo_notes(lawful)
    assert note.startswith(f"objects.box: diffuse + specular is {1 / min(factors):.4f}, which is")


def test_too_much_is_refused_before_indices_wrap() -> None:
    many = trimesh.creation.icosphere(6)  # 81920 triangles, more than a material index can tell
    description = described(*MATERIAL, rand_tri_diffuse_seed=1, smooth_shading=False)
    with pytest.raises(TrilightError, match="81921 materials; expected at most 65536"):
        built(description, loaded(many))
    with pytest.raises(TrilightError, match="objects.light: 81920 emitting triangles"):
        built(described(), light=loaded(many, "light.obj"))


def test_the_random_colours_of_compose_scene_are_the_published_ones(shared: Path) -> None:
    """Draw as the published converter does: a triple for each part of the split triangle soup."""
    scene = example_scene(shared, "compose-scene")
    path = shared / "renderformer_scenes/objects/compose/obj0.obj"
    mesh = trimesh.load_mesh(path, process=False)
    soup = trimesh.Trimesh(
        vertices=mesh.triangles.reshape(-1, 3),
        faces=np.arange(3 * len(mesh.faces)).reshape(-1, 3),
        process=False,
    )
    generator = np.random.RandomState(42)
    drawn = [
        (part.triangles[0], generator.randint(0, math.ceil(256 * 0.5), (1, 3))[0] / 255)
        for part in soup.split(only_watertight=False)
    ]
    assert len(drawn) == 224
    mine = scene.object_index == 1
    found = scene.materials[scene.material_index[mine], DIFFUSE]
    for triangle, corners, colour in zip(drawn, corners_of(scene, 1), found, strict=True):
        np.testing.assert_allclose(corners, triangle[0], atol=1e-7)  # float32 of at most 0.5
        np.testing.assert_allclose(colour, triangle[1], atol=1e-7)


@pytest.mark.parametrize(("kind", "count"), [("per-triangle", 256), ("per-shading-group", 3)])
def test_random_colours_of_a_smooth_mesh(kind: str, count: int) -> None:
    rod = trimesh.creation.cylinder(0.3, 1.0, sections=64)  # two caps, and one side of 128
    change = {"rand_tri_diffuse_seed": 7, "random_diffuse_type": kind}
    scene = built(described(*MATERIAL, **change), loaded(rod))
    mine = scene.object_index == 0
    colours = scene.materials[scene.material_index[mine], DIFFUSE]
    different, rows = np.unique(colours, axis=0, return_inverse=True)
    assert len(different) == count
    assert 0 < colours.max() <= 0.5
    if count == 3:
        assert sorted(np.bincount(rows)) == [64, 64, 128]
    other = built(described(*MATERIAL, **{**change, "rand_tri_diffuse_seed": 8}), loaded(rod))
    assert not np.array_equal(other.materials, scene.materials)
