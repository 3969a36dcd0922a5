"""Exact values where another program kept them, changed what stands beside them, or lost it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom

from pipeline.exchange.textured_triangles import LoadedScene
from pipeline.exchange.usd.read_usd import read_usd
from pipeline.exchange.usd.write_usd import CENTER, write_usd
from storage.records.material import PUBLISHED_COLUMNS
from storage.records.scene import Scene
from storage.records.scene_file import encode_scene
from storage.records.texture import Texture
from tests.columns_kit import COAT, WAVES, declared
from tests.for_each import case, for_each, with_folders
from tests.scenes_by_hand import FLOOR, LIGHT, tiny_scene
from tests.textured_by_hand import number_texture, sky, textured_scene

MATERIAL = f"/Scene/Materials/material_{FLOOR}"
PREVIEW, OPENPBR = "/Preview.inputs:roughness", "/OpenPBR.inputs:specular_roughness"
MOVE = np.array([1.0, 2.0, 3.0])


def edited(tmp_path: Path, scene: Scene, edit: Callable[[Any], None]) -> LoadedScene:
    """Return what is read after an edit of the layer that we wrote."""
    write_usd(tmp_path / "a.usda", scene)
    layer = Sdf.Layer.OpenAsAnonymous(str(tmp_path / "a.usda"))
    edit(layer)
    layer.Export(str(tmp_path / "b.usda"))
    return read_usd(tmp_path / "b.usda", None, None, "CC0-1.0")


def as_blender_writes(layer: Any) -> None:
    """Leave what Blender does: no marks of ours, the metallic workflow, one index of refraction."""
    scene = layer.GetPrimAtPath("/Scene")
    for name in ("trilight:schemaVersion", "trilight:sceneSha256"):
        del scene.properties[name]
    for material in layer.GetPrimAtPath("/Scene/Materials").nameChildren:
        if "OpenPBR" in material.nameChildren:
            del material.nameChildren["OpenPBR"]
            del material.properties["outputs:mtlx:surface"]
        for shader in material.nameChildren:
            for name in list(shader.properties.keys()):
                if "pecular" in name or name.startswith("trilight:"):
                    del shader.properties[name]


def set_values(*edits: tuple[str, Any]) -> Callable[[Any], None]:
    def edit(layer: Any) -> None:
        for path, value in edits:
            layer.GetAttributeAtPath(f"{MATERIAL}{path}").default = value

    return edit


def do_nothing(layer: Any) -> None:
    pass


def move_light(layer: Any) -> None:
    """Move what no digest of the scene then tells apart from a changed material."""
    layer.GetAttributeAtPath(f"/Scene/Objects/light.{CENTER}").default = (0.0, 0.5, 2.0)


def rows(scene: Scene) -> np.ndarray:
    return np.asarray(scene.materials[scene.material_index])


COLUMNS = {
    "diffuse": (slice(0, 3), "trilight:diffuseAlbedo", "diffuseColor", (0.1, 0.2, 0.3)),
    "specular": (slice(3, 6), "trilight:specularAlbedo", "specularColor", (0.3, 0.2, 0.1)),
    "roughness": (slice(6, 7), "trilight:roughness", "roughness", 0.25),
    "emission": (slice(7, 10), "trilight:emittedRadiance", "emissiveColor", (1, 2, 3)),
}
OF_OPENPBR = [
    ("diffuse", "base_color", (0.1, 0.2, 0.3), (0.1, 0.2, 0.3)),
    ("diffuse", "base_weight", 0.5, (0.25, 0.2, 0.15)),
    ("specular", "specular_weight", 0.5, 0.1),
    ("specular", "specular_color", (1, 0.5, 0), (0.2, 0.1, 0)),
    ("specular", "specular_ior", 3.0, 0.25),
    ("roughness", "specular_roughness", 0.25, 0.25),
    ("emission", "emission_luminance", 7.0, 7),
]
EDITS = [
    *((name, f".{ours}", value, value, ours) for name, (_, ours, _, value) in COLUMNS.items()),
    *(
        (name, f"/Preview.inputs:{theirs}", value, value, "its shader Preview")
        for name, (_, _, theirs, value) in COLUMNS.items()
    ),
    *(
        (name, f"/OpenPBR.inputs:{theirs}", value, read, "its shader OpenPBR")
        for name, theirs, value, read in OF_OPENPBR
    ),
]
"""Column, changed attribute, its value, the value that is read, and the place in its note."""


def assert_changed(found: LoadedScene, scene: Scene, column: str, value: Any, place: str) -> None:
    """The column of the floor alone has the value, and one note says from where."""
    expected = rows(scene).copy()
    expected[:2, COLUMNS[column][0]] = value
    emits = [2, 0, 1] if column == "emission" else [0, 1, 2]
    sorted_rows = np.sort(rows(found.scene), axis=0)
    wanted = np.sort(expected[emits], axis=0)
    if place == "its shader OpenPBR":
        assert sorted_rows == pytest.approx(wanted, rel=1e-5)
    else:
        assert np.array_equal(sorted_rows, wanted)
    (said,) = [text for text in found.notes if " was changed since" in text]
    assert said.startswith(f"{MATERIAL}: {column} was changed")
    assert f"the value of {place} is used" in said


@for_each("besides", [do_nothing, move_light, as_blender_writes])
def test_an_edit_changes_its_column_alone(tmp_path: Path, besides: Callable[[Any], None]) -> None:
    """Of each column in each place; Blender keeps what stands in the preview alone."""
    in_blender = besides is as_blender_writes
    kept = [e for e in EDITS if not in_blender or ("/Preview" in e[1] and e[0] != "specular")]
    assert len(kept) == 3 if in_blender else {e[0] for e in kept} == set(PUBLISHED_COLUMNS)
    for folder, (column, path, value, read, place) in with_folders(tmp_path, kept):
        with case(path):

            def edit(layer: Any, path: str = path, value: Any = value) -> None:
                set_values((path, value))(layer)
                besides(layer)

            scene = tiny_scene()
            assert_changed(edited(folder, scene, edit), scene, column, read, place)


def test_constants_beside_textures_are_read_where_they_were_changed(tmp_path: Path) -> None:
    """Such a material has no OpenPBR: the digest tells which of two places was changed."""
    constants = [e for e in EDITS if e[0] in ("specular", "emission") and "OpenPBR" not in e[1]]
    for folder, (column, path, value, _, place) in with_folders(tmp_path, constants):
        scene = textured_scene()
        found = edited(folder, scene, set_values((path, value)))
        assert (
            rows(found.scene)[:, COLUMNS[column][0]].tolist().count(pytest.approx(value, rel=1e-6))
            == 2
        )
        (said,) = [text for text in found.notes if " was changed since" in text]
        assert f"{column} was changed" in said and f"the value of {place} is used" in said
    found = edited(tmp_path, textured_scene(), set_values((".trilight:diffuseAlbedo", (0, 0, 0))))
    assert any("diffuse has a texture, which is used" in text for text in found.notes)
    assert [t.sha256 for t in found.scene.textures] == [t.sha256 for t in textured_scene().textures]


@for_each(
    "changed, expected, said",
    [
        (((".trilight:roughness", 0.9), (PREVIEW, 0.7)), 0.9, "not of its shader Preview or its"),
        (((PREVIEW, 0.7), (OPENPBR, 0.8)), 0.7, "not of its shader OpenPBR"),
        (((PREVIEW, 0.7), (OPENPBR, 0.7)), 0.7, "the value of its shader Preview is used"),
        (((".trilight:roughness", 0.9), (OPENPBR, 0.8)), 0.9, "not of its shader OpenPBR"),
    ],
)
def test_of_several_changes_the_first_place_counts(
    tmp_path: Path, changed: Any, expected: float, said: str
) -> None:
    found = edited(tmp_path, tiny_scene(), set_values(*changed))
    assert rows(found.scene)[0, 6] == np.float32(expected)
    assert any(said in text for text in found.notes)


@for_each(
    "path, value",
    [
        ("/OpenPBR.inputs:base_diffuse_roughness", 0.5),
        ("/Preview.inputs:ior", 1.5),
        ("/Preview.inputs:useSpecularWorkflow", 0),
    ],
)
def test_a_change_that_no_column_holds_is_said(tmp_path: Path, path: str, value: Any) -> None:
    found = edited(tmp_path, tiny_scene(), set_values((path, value)))
    assert np.array_equal(rows(found.scene), rows(tiny_scene()))
    name = path.replace("inputs:", "")
    assert [f"{MATERIAL}{name}: has no place here"] == [t for t in found.notes if "no place" in t]


def test_an_added_column_is_read_as_it_was_changed(tmp_path: Path) -> None:
    with declared(COAT):
        scene = tiny_scene()
        scene.materials[:, -1] = 0.5
        found = edited(tmp_path, scene, set_values((".trilight:column:coat", 0.25)))
        assert rows(found.scene)[:, -1].tolist() == [0.25, 0.25, 0.5]


@pytest.mark.parametrize("specular", [False, True])
def test_what_blender_loses_is_still_there(tmp_path: Path, specular: bool) -> None:
    scene = textured_scene(environment=sky())
    if specular:
        gloss = Texture(texels=np.array([[[9, 9, 9], [50, 40, 30]]], np.uint8))
        index = np.array([[-1, 1, 0], [-1, -1, -1]], np.int32)
        scene = textured_scene(0, number_texture(), gloss, material_textures=index)
    found = edited(tmp_path, scene, as_blender_writes)
    assert len(found.notes) == 1
    assert {t.sha256: t.source for t in found.scene.textures} == {
        t.sha256: t.source for t in scene.textures
    }
    assert np.array_equal(rows(found.scene)[2], rows(scene)[2])
    assert found.scene.objects == scene.objects


def drop_shader(layer: Any) -> None:
    del layer.GetPrimAtPath(MATERIAL).nameChildren["Preview"]
    del layer.GetPrimAtPath(MATERIAL).nameChildren["OpenPBR"]


def drop_preview(layer: Any) -> None:
    """Leave the OpenPBR shader as the only one; change it and see that lights still shine."""
    for material in layer.GetPrimAtPath("/Scene/Materials").nameChildren:
        del material.nameChildren["Preview"]
    set_values(("/OpenPBR.inputs:base_color", (0.1, 0.4, 0.3)))(layer)


def to_metal(layer: Any) -> None:
    as_blender_writes(layer)
    metal = Sdf.AttributeSpec(
        layer.GetPrimAtPath(f"{MATERIAL}/Preview"), "inputs:metallic", Sdf.ValueTypeNames.Float
    )
    metal.default = 1.0


def spoil(layer: Any) -> None:
    layer.GetAttributeAtPath(f"{MATERIAL}.trilight:diffuseAlbedo").default = (0.5, np.nan, 7.0)


@for_each(
    "edit, albedos, said",
    [
        (drop_shader, (0.5, 0.4, 0.3, 0.2, 0.2, 0.2), "the values that Trilight wrote are used"),
        (to_metal, (0, 0, 0, 11 / 21, 9 / 21, 7 / 21), "became a metal"),
        (spoil, (0.5, 0.4, 0.3, 0.2, 0.2, 0.2), "diffuseAlbedo: expected 3 numbers from 0 to 1"),
        (drop_preview, (0.1, 0.4, 0.3, 0.2, 0.2, 0.2), "the value of its shader OpenPBR is used"),
    ],
)
def test_what_is_no_longer_so_is_said(
    tmp_path: Path, edit: Callable[[Any], None], albedos: tuple[float, ...], said: str
) -> None:
    found = edited(tmp_path, tiny_scene(), edit)
    assert rows(found.scene)[0, :6] == pytest.approx(albedos, rel=1e-6)
    assert any(said in text for text in found.notes)
    assert np.array_equal(rows(found.scene)[2], rows(tiny_scene())[2])


def test_a_column_that_blender_drops_is_named(tmp_path: Path) -> None:
    def drop_array(layer: Any) -> None:
        as_blender_writes(layer)
        for material in layer.GetPrimAtPath("/Scene/Materials").nameChildren:
            del material.properties[f"trilight:column:{WAVES.name}"]

    with declared(COAT, WAVES):
        scene = tiny_scene()
        scene.materials[:, -WAVES.width :] = 0.25
        found = edited(tmp_path, scene, drop_array)
    notes = [text for text in found.notes if "is not in the file any more" in text]
    assert notes and all(f"{WAVES.name!r}" in text for text in notes)


def test_moved_objects_are_read_as_moved(tmp_path: Path) -> None:
    def move(layer: Any) -> None:
        stage = Usd.Stage.Open(layer)
        light = UsdGeom.Xformable(stage.GetPrimAtPath("/Scene/Objects/light"))
        center = np.array(light.GetPrim().GetAttribute(CENTER).Get())
        assert UsdGeom.XformCommonAPI(light).SetTranslate((center + MOVE).tolist())

    scene = tiny_scene()
    found = edited(tmp_path, scene, move)
    assert any("changed since Trilight wrote it: read as any other" in text for text in found.notes)
    was, now = (s.vertex_positions[s.faces[2]] for s in (scene, found.scene))
    assert now == pytest.approx(was + MOVE, abs=1e-6)


def test_objects_turn_about_their_centers(tmp_path: Path) -> None:
    def turn(layer: Any) -> None:
        stage = Usd.Stage.Open(layer)
        UsdGeom.Xformable(stage.GetPrimAtPath("/Scene/Objects/light")).AddRotateZOp().Set(180)

    scene = tiny_scene()
    found = edited(tmp_path, scene, turn)
    assert any("changed since Trilight wrote it: read as any other" in text for text in found.notes)
    was, now = (s.vertex_positions[s.faces[2]] for s in (scene, found.scene))
    assert now.mean(axis=0)[2] == 2
    assert np.array_equal(rows(found.scene)[2], scene.materials[LIGHT])
    middle = (was.min(axis=0) + was.max(axis=0)) / 2
    assert now == pytest.approx((middle - was) * [1, 1, 0] + middle, abs=1e-6)


def test_a_file_with_the_older_name_of_centers_is_exact(tmp_path: Path) -> None:
    """As the example that comes with the checkout is."""
    room = Path(__file__).parents[4] / "examples" / "room.usdz"
    assert "xformOp:translate:center" in Sdf.Layer.FindOrOpen(str(room)).ExportToString()
    found = read_usd(room, None, None, "CC0-1.0")
    assert not found.notes
    write_usd(tmp_path / "again.usdz", found.scene)
    again = read_usd(tmp_path / "again.usdz", None, None, "CC0-1.0")
    assert not again.notes and encode_scene(again.scene) == encode_scene(found.scene)
