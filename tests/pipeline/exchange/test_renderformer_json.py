"""RenderFormer's JSON: what is read, what is refused with file, field, got and expected, and a
scene written and read again: the same triangles in the same light."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.exchange.renderformer_json import MAX_BYTES, describe_scene, read_description
from storage.errors import TrilightError
from storage.records.scene import SceneObject
from tests.for_each import for_each
from tests.pipeline.exchange.exchange_kit import assert_json_keeps_light, json_and_back
from tests.pipeline.scenes.example_scenes import EXAMPLES
from tests.pipeline.scenes.one_box import BOX, CAMERA, MATERIAL, OBJECT, SCENE, TRANSFORM, changed
from tests.scenes_by_hand import LIGHT, tiny_scene


@for_each("name", EXAMPLES)
def test_the_example_scenes_hold_no_unknown_field(shared: Path, name: str) -> None:
    data = (shared / "renderformer_scenes" / f"{name}.json").read_bytes()
    described = read_description(data, name)
    assert described.unknown_fields == ()
    assert [entry.name for entry in described.objects] == list(json.loads(data)["objects"])
    assert len(described.cameras) == 1


def test_what_may_be_missing_has_the_published_default() -> None:
    scene = json.loads(changed())
    del scene["objects"]["box"]["transform"]["normalize"]
    for name in ("rand_tri_diffuse_seed", "random_diffuse_max", "random_diffuse_type"):
        del scene["objects"]["box"]["material"][name]
    (box,) = read_description(json.dumps(scene).encode(), "a.json").objects
    assert box.transform.normalize
    assert box.material.rand_tri_diffuse_seed is None
    assert box.material.random_diffuse_max == 1
    assert box.material.random_diffuse_type == "per-shading-group"
    assert (box.remesh, box.remesh_target_face_num) == (False, 2048)
    (box,) = read_description(changed(*MATERIAL, rand_tri_diffuse_seed=0), "a.json").objects
    assert box.material.rand_tri_diffuse_seed == 0


def test_unknown_fields_are_named_and_harmless() -> None:
    scene = json.loads(changed())
    scene["environment"] = {}
    scene["objects"]["box"]["material"]["ruoghness"] = 1
    scene["objects"]["box"]["transform"]["line\nbreak"] = 1
    scene["cameras"][0]["near"] = 0.1
    described = read_description(json.dumps(scene).encode(), "a.json")
    assert sorted(described.unknown_fields) == sorted(
        [
            "environment",
            "objects.box.material.ruoghness",
            repr("objects.box.transform.line\nbreak"),
            "cameras[0].near",
        ]
    )
    assert described.objects == read_description(changed(), "a.json").objects


REFUSED = [
    (changed(version="2.0"), "version is '2.0'; expected '1.0'"),
    (changed(objects={str(i): 1 for i in range(8193)}), "8193 objects; expected 1 to 8192"),
    (changed(objects=[]), "objects is []; expected a JSON object"),
    (changed(objects={"a": 1}), "objects.a is 1; expected a JSON object"),
    (changed(objects={"a\nb": OBJECT}), "expected a printable name"),
    (changed(cameras=[]), "cameras is []; expected a list of 1 to 1000"),
    (changed(scene_name=...), "scene_name is missing"),
    (changed(*BOX, mesh_path="a\0b"), "objects.box.mesh_path is 'a\\x00b'; expected printable"),
    (changed(*BOX, mesh_path="\ud800"), "objects.box is nested too deeply, or holds half a char"),
    (
        changed(*BOX, mesh_path=...)[:-1] + b"," + b'"a":' + b"[" * 300 + b"]" * 300 + b"}",
        "missing",
    ),
    (changed().replace(b'"box.obj"', b"[" * 900 + b"]" * 900), "objects.box is nested too deeply"),
    (changed(*BOX, remesh_target_face_num=2), "is 2; expected a whole number from 4"),
    (changed(*TRANSFORM, normalize="yes"), "transform.normalize is yes; expected true or false"),
    (changed(*TRANSFORM, scale=2), "objects.box.transform.scale is 2; expected a list of three"),
    (changed(*TRANSFORM, translation=[1e9, 0, 0]), "translation[0] is 1000000000.0; expected a nu"),
    (changed(*TRANSFORM, translation=[10**400, 0, 0]), "translation[0] is 1000000"),
    (changed(*MATERIAL, diffuse=[0.5, 0.5, 1.5]), "diffuse[2] is 1.5; expected a number from 0 to"),
    (changed(*MATERIAL, diffuse=[True, 0, 0]), "diffuse[0] is True; expected a number"),
    (changed(*MATERIAL, random_diffuse_type="x"), "is x; expected one of per-triangle, per-shadi"),
    (changed(*MATERIAL, rand_tri_diffuse_seed=1.5), "is 1.5; expected a whole number"),
    (changed().replace(b"40", b"1e999"), "cameras[0].fov is inf; expected a number"),
    (b"", "not readable as JSON"),
    (b"[" * 100_000, "a.json: "),
    (b"[]", "the file is []; expected a JSON object"),
    (b'{"a": NaN}', "NaN is no JSON number"),
    (b'{"a": 1' + b"0" * 5000 + b"}", "not readable as JSON"),
    (b'{"a": 1, "a": 2}', "the name 'a' stands twice"),
    (b" " * (MAX_BYTES + 1), "expected at most 4194304"),
]


@for_each("data, message", REFUSED)
def test_what_is_wrong_is_named(data: bytes, message: str) -> None:
    with pytest.raises(TrilightError) as caught:
        read_description(data, "a.json")
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
            _expect_refusal(changed(*path, **{name: {"x": "y"}}))
            if name not in optional:
                _expect_refusal(changed(*path, **{name: ...}))

    visit((), {name: value for name, value in SCENE.items() if name != "objects"})
    visit(BOX, OBJECT)
    visit(CAMERA, SCENE["cameras"][0])  # type: ignore[index]


def _expect_refusal(data: bytes) -> None:
    with pytest.raises(TrilightError):
        read_description(data, "a.json")


def test_a_scene_by_hand(tmp_path: Path) -> None:
    back, lost = json_and_back(tiny_scene(), tmp_path)
    assert_json_keeps_light(back, tiny_scene())
    assert np.array_equal(
        back.vertex_normals[back.faces], tiny_scene().vertex_normals[tiny_scene().faces]
    )
    assert [(o.name, o.kind) for o in back.objects] == [("floor", "shell"), ("light", "emitter")]
    assert lost == ()
    described = json.loads((tmp_path / "again.json").read_text())
    assert described["objects"]["floor"]["mesh_path"].startswith("templates/backgrounds/")


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


def test_normals_that_no_reader_makes_are_said_to_be_lost(tmp_path: Path) -> None:
    base = tiny_scene()
    normals = base.vertex_normals.copy()
    normals[0] = [0.6, 0, 0.8]
    _, lost = json_and_back(dataclasses.replace(base, vertex_normals=normals), tmp_path)
    assert "floor: shading normals, which readers compute again" in lost


def test_too_much_light_and_too_many_objects(monkeypatch: pytest.MonkeyPatch) -> None:
    bright = tiny_scene()
    bright.materials[LIGHT, 7:] = 65505
    assert any("cuts off" in text for text in describe_scene(bright, "a").lost)
    monkeypatch.setattr("pipeline.exchange.renderformer_json.MAX_OBJECTS", 1)
    with pytest.raises(TrilightError, match="2 objects of one material; expected at most 1"):
        describe_scene(tiny_scene(), "a")
