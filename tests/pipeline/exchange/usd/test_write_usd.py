"""A scene in USD: valid by USD's own judges, exact on the way back, and nothing of this machine."""

import dataclasses
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pxr import Sdf, Usd, UsdGeom, UsdLux, UsdShade

from pipeline.exchange.usd.read_usd import read_usd, usd_keys
from pipeline.exchange.usd.write_usd import SUFFIXES, write_usd, write_usd_shard
from storage.conventions import look_at_c2w
from storage.errors import TrilightError
from storage.records.scene import Scene, SceneObject
from storage.records.scene_file import encode_scene
from tests.for_each import for_each
from tests.pipeline.exchange.exchange_kit import errors_of
from tests.scenes_by_hand import LIGHT, tiny_scene

OPENPBR_INPUTS = {
    "base_color": "color3f",
    "base_weight": "float",
    "base_diffuse_roughness": "float",
    "specular_weight": "float",
    "specular_color": "color3f",
    "specular_roughness": "float",
    "specular_ior": "float",
    "emission_luminance": "float",
    "emission_color": "color3f",
}
"""What we write of OpenPBR 1.1's node in MaterialX, by type: no validator knows the node."""


def written(tmp_path: Path, scene: Scene, name: str = "a.usdc") -> Any:
    write_usd(tmp_path / name, scene)
    return Usd.Stage.Open(str(tmp_path / name))


def odd_scene() -> Scene:
    """Objects that share vertices and interleave, one without triangles, vertices without any."""
    base = tiny_scene()
    rows = np.concatenate([base.materials, base.materials[:1], base.materials[LIGHT:]])
    rows[2, :7] = [0, 0, 0, 1, 1, 1, 0]
    return tiny_scene(
        vertex_positions=np.concatenate([base.vertex_positions, [[-0.0, 1e-40, 999.9]]]).astype(
            np.float32
        ),
        vertex_normals=np.concatenate([base.vertex_normals, [[0, 1, 0]]]).astype(np.float32),
        faces=np.array([[0, 1, 2], [4, 5, 6], [0, 2, 3], [1, 2, 3]], np.uint32),
        material_index=np.array([2, LIGHT, 0, 2], np.uint16),
        materials=rows,
        object_index=np.array([1, 2, 3, 1], np.uint16),
        objects=(
            SceneObject(name="nothing", kind="object"),
            SceneObject(name='"1 ü\n\\', kind="object", uid="u", licence="MIT", attribution="Ö"),
            SceneObject(name="light", kind="emitter"),
            SceneObject(name="_1____", kind="shell", source_url="x"),
        ),
        provenance={"a": [1, 2.5, None, {"b": "ü"}]},
    )


def test_validators_would_see_a_mistake(tmp_path: Path) -> None:
    stage = written(tmp_path, tiny_scene())
    stage.ClearDefaultPrim()
    assert errors_of(stage)


@for_each("suffix", SUFFIXES)
def test_there_and_back_is_exact_and_valid(tmp_path: Path, suffix: str) -> None:
    scene = odd_scene()
    path = tmp_path / f"a{suffix}"
    assert errors_of(written(tmp_path, scene, path.name)) == []
    back = read_usd(path, None, None, "")
    assert back.notes == () and encode_scene(back.scene) == encode_scene(scene)
    assert usd_keys(path) == [""]
    write_usd(tmp_path / f"b{suffix}", back.scene)
    assert (tmp_path / f"b{suffix}").read_bytes() == path.read_bytes()


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """Any lawful scene: random rows everywhere, floats of every size."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count, triangles, materials, objects = (int(n) for n in rng.integers(3, 9, 4))
    scale = 10.0 ** draw(st.integers(-30, 2))
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rows = np.zeros((materials, 10), np.float32)
    rows[:, :6], rows[:, 6] = rng.random((materials, 6)) / 2, rng.random(materials)
    rows[-1, 7:] = rng.random(3) * 10.0 ** draw(st.integers(-20, 20)) + 1e-30
    emits = np.arange(triangles) == triangles - 1
    pose = look_at_c2w(eye=rng.normal(size=3), target=rng.normal(size=3), up=rng.normal(size=3))
    text = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=8)
    return Scene(
        vertex_positions=(scale * rng.normal(size=(count, 3))).astype(np.float32),
        vertex_normals=normals.astype(np.float32),
        faces=rng.integers(0, count, (triangles, 3)).astype(np.uint32),
        material_index=np.where(
            emits, materials - 1, rng.integers(0, materials - 1, triangles)
        ).astype(np.uint16),
        materials=rows,
        object_index=np.where(emits, objects - 1, rng.integers(0, objects - 1, triangles)).astype(
            np.uint16
        ),
        c2w=pose[None].astype(np.float32),
        fov_deg=rng.uniform(1e-3, 179.9, 1).astype(np.float32),
        objects=tuple(
            SceneObject(
                name=f"{row}{draw(text)}",
                kind="emitter" if row == objects - 1 else "object",
                **{field: draw(text) for field in ("uid", "attribution")},
            )
            for row in range(objects)
        ),
        provenance={
            "text": draw(text),
            "number": draw(st.floats(allow_nan=False, allow_infinity=False)),
        },
    )


@settings(max_examples=20, deadline=None)
@given(scene=scenes(), suffix=st.sampled_from(SUFFIXES))
def test_any_scene_comes_back(tmp_path_factory: Any, scene: Scene, suffix: str) -> None:
    path = tmp_path_factory.mktemp("usd") / f"a{suffix}"
    write_usd(path, scene)
    back = read_usd(path, None, None, "")
    assert back.notes == () and encode_scene(back.scene) == encode_scene(scene)


def test_stage_says_units_and_holds_no_path(tmp_path: Path) -> None:
    stage = written(tmp_path, tiny_scene(), "a.usda")
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert stage.GetDefaultPrim().GetPath() == "/Scene"
    text = (tmp_path / "a.usda").read_text()
    assert str(tmp_path) not in text and "@" not in text


def test_cameras_have_a_lens_in_tenths_of_a_metre(tmp_path: Path) -> None:
    scene = tiny_scene()
    stage = written(tmp_path, scene)
    for view in range(2):
        camera = UsdGeom.Camera.Get(stage, f"/Scene/Cameras/camera_{view}").GetCamera()
        # single precision of focal length and aperture
        assert camera.GetFieldOfView(camera.FOVHorizontal) == pytest.approx(
            scene.fov_deg[view], rel=1e-6
        )
        assert camera.horizontalAperture == camera.verticalAperture
        assert camera.focalLength / 10 == pytest.approx(  # tenths of a metre
            0.018 / math.tan(math.radians(float(scene.fov_deg[view])) / 2), rel=1e-6
        )
        assert np.array_equal(np.array(camera.transform).T, scene.c2w[view].astype(np.float64))


def test_materials_are_bound_by_subsets_and_say_the_same_thrice(tmp_path: Path) -> None:
    scene = odd_scene()
    stage = written(tmp_path, scene)
    for prim in stage.Traverse():
        if not prim.IsA(UsdGeom.Mesh):
            continue
        subsets = UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets()
        rows = np.array(prim.GetAttribute("trilight:faceRows").Get())
        assert sorted(i for s in subsets for i in s.GetIndicesAttr().Get()) == list(
            range(len(rows))
        )
        for subset in subsets:
            material = UsdShade.MaterialBindingAPI(subset).ComputeBoundMaterial()[0]
            (row,) = set(scene.material_index[rows[list(subset.GetIndicesAttr().Get())]])
            assert_material(material, scene.materials[row])


def assert_material(material: Any, values: np.ndarray) -> None:
    preview = material.ComputeSurfaceSource("")[0]
    openpbr = material.ComputeSurfaceSource("mtlx")[0]
    assert preview.GetShaderId() == "UsdPreviewSurface"
    assert preview.GetInput("useSpecularWorkflow").Get() == 1
    colours = {
        "diffuseColor": values[:3],
        "specularColor": values[3:6],
        "emissiveColor": values[7:],
    }
    for name, expected in colours.items():
        assert np.array_equal(np.array(preview.GetInput(name).Get(), np.float32), expected)
    assert preview.GetInput("roughness").Get() == values[6]
    assert openpbr.GetShaderId() == "ND_open_pbr_surface_surfaceshader"
    found = {i.GetBaseName(): str(i.GetTypeName()) for i in openpbr.GetInputs()}
    assert found == OPENPBR_INPUTS
    luminance = openpbr.GetInput("emission_luminance").Get()
    emission = luminance * np.array(openpbr.GetInput("emission_color").Get())
    assert emission == pytest.approx(values[7:], rel=1e-6)  # a quotient in single precision
    ior = openpbr.GetInput("specular_ior").Get()
    head_on = ((ior - 1) / (ior + 1)) ** 2 * np.array(openpbr.GetInput("specular_color").Get())
    # beyond 0.98 no index is sought
    assert head_on == pytest.approx(np.minimum(values[3:6], 0.98), abs=1e-5)


def test_an_emitter_is_a_light_and_glows_on_both_sides(tmp_path: Path) -> None:
    stage = written(tmp_path, tiny_scene())
    light = stage.GetPrimAtPath("/Scene/Objects/light")
    assert light.HasAPI(UsdLux.MeshLightAPI)
    assert UsdLux.LightAPI(light).GetIntensityAttr().Get() == 1
    assert UsdGeom.Mesh(light).GetDoubleSidedAttr().Get() is True
    assert light.GetAttribute("trilight:visibleToCamera").Get() is False
    floor = stage.GetPrimAtPath("/Scene/Objects/floor")
    assert not floor.HasAPI(UsdLux.MeshLightAPI)
    assert floor.GetAttribute("trilight:licence").Get() == "CC0-1.0"


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_shard_shows_one_scene_at_a_time(tmp_path: Path, suffix: str) -> None:
    kept = {"000000001": tiny_scene(), "000000007": odd_scene()}
    write_usd_shard(tmp_path / f"s{suffix}", kept.items())
    stage = Usd.Stage.Open(str(tmp_path / f"s{suffix}"))
    assert errors_of(stage) == []
    for key, scene in kept.items():
        stage.GetPrimAtPath("/Scenes").GetVariantSet("scene").SetVariantSelection(key)
        meshes = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
        assert len(meshes) == len(set(scene.object_index))
        found = read_usd(tmp_path / f"s{suffix}", key, None, "")
        assert encode_scene(found.scene) == encode_scene(scene)
    assert usd_keys(tmp_path / f"s{suffix}") == list(kept)
    with pytest.raises(TrilightError, match="no scene 000000003; expected one of 000000001"):
        read_usd(tmp_path / f"s{suffix}", "000000003", None, "")


def edits() -> Iterable[tuple[str, str, Any]]:
    yield "/Scene/Objects/floor.points", "default", [(0, 0, 0)] * 4
    yield "/Scene/Materials/material_0/Preview.inputs:diffuseColor", "default", (0.1, 0.1, 0.1)
    yield "/Scene/Materials/material_0/OpenPBR.inputs:base_color", "default", (0.1, 0.1, 0.1)
    yield "/Scene/Objects/light.inputs:intensity", "default", 3.0
    yield "/Scene/Cameras/camera_0.focalLength", "default", 3.0
    yield "/Scene/Objects/floor", "active", False
    yield "/Scene/Objects/floor", "instanceable", True


@for_each("path, field, value", edits())
def test_what_was_changed_is_no_longer_ours(
    tmp_path: Path, path: str, field: str, value: Any
) -> None:
    write_usd(tmp_path / "a.usda", tiny_scene())
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "a.usda"))
    spec = layer.GetObjectAtPath(path)
    if field == "default":
        spec.default = value
    else:
        spec.SetInfo(field, value)
    layer.Export(str(tmp_path / "b.usda"))
    assert read_usd(tmp_path / "b.usda", None, None, "").notes


def test_what_was_added_is_no_longer_ours(tmp_path: Path) -> None:
    stage = written(tmp_path, tiny_scene())
    UsdLux.SphereLight.Define(stage, "/Scene/Objects/more")
    stage.Save()
    assert read_usd(tmp_path / "a.usdc", None, None, "").notes


@pytest.mark.parametrize(
    ("scene", "name", "message"),
    [
        (tiny_scene(), "a.usd", "ends in .usda, .usdc, .usdz"),
        (tiny_scene(fov_deg=np.array([45, 181], np.float32)), "a.usda", "fov_deg"),
        (
            dataclasses.replace(
                tiny_scene(),
                objects=(SceneObject(name="a\0b", kind="shell"), tiny_scene().objects[1]),
            ),
            "a.usda",
            "a character that USD cannot store",
        ),
    ],
)
def test_what_is_not_written(tmp_path: Path, scene: Scene, name: str, message: str) -> None:
    with pytest.raises(TrilightError, match=message):
        write_usd(tmp_path / name, scene)
    assert not list(tmp_path.iterdir())
