"""A scene in USD: valid by USD's own judges, exact on the way back, and nothing of this machine."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade

from pipeline.exchange.formats import FORMATS, drop_uncarried_maps, list_lost_members
from pipeline.exchange.textured_triangles import LoadedScene
from pipeline.exchange.usd import layout
from pipeline.exchange.usd.read_usd import read_usd, usd_keys
from pipeline.exchange.usd.write_usd import (
    author_scene,
    new_layer,
    write_usd,
    write_usd_shard,
)
from pipeline.foreign.limits import WRITTEN_USD_SUFFIXES
from scene_templates.rotations import uniform_rotation
from storage.conventions import linear_from_srgb8
from storage.errors import TrilightError
from storage.records.exr import encode_channels
from storage.records.lookup import environment_values
from storage.records.scene import Scene, SceneObject
from storage.records.scene_file import encode_scene, scene_digest
from storage.records.texture import Environment, MapSource, Texture
from tests.for_each import with_folders
from tests.pipeline.exchange.exchange_kit import assert_usd_keeps_all, edited_layer, errors_of
from tests.pipeline.foreign.test_light_pictures import radiance_hdr
from tests.scenes_by_hand import FLOOR, LIGHT, tiny_scene
from tests.sky_maps import COLOURS, POLES, one_sun, six_poles, smooth
from tests.textured_by_hand import bumpy_scene, number_texture, sky, textured_scene

OPENPBR_INPUTS = {
    **dict.fromkeys(("base_color", "specular_color", "emission_color"), "color3f"),
    **dict.fromkeys(("base_weight", "base_diffuse_roughness", "emission_luminance"), "float"),
    **dict.fromkeys(("specular_weight", "specular_roughness", "specular_ior"), "float"),
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
    places = np.concatenate([base.vertex_positions, [[-0.0, 1e-40, 999.9]]])
    return tiny_scene(
        vertex_positions=places.astype(np.float32),
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

    def rows_of(count: int) -> NDArray[np.uint16]:
        others = rng.integers(0, count - 1, triangles)
        return np.where(emits, count - 1, others).astype(np.uint16)

    text = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=8)
    return tiny_scene(
        vertex_positions=(scale * rng.normal(size=(count, 3))).astype(np.float32),
        vertex_normals=normals.astype(np.float32),
        faces=rng.integers(0, count, (triangles, 3)).astype(np.uint32),
        material_index=rows_of(materials),
        materials=rows,
        object_index=rows_of(objects),
        fov_deg=rng.uniform(1e-3, 179.9, 2).astype(np.float32),
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
@given(scene=scenes(), suffix=st.sampled_from(WRITTEN_USD_SUFFIXES))
def test_any_scene_comes_back(tmp_path_factory: Any, scene: Scene, suffix: str) -> None:
    path = tmp_path_factory.mktemp("usd") / f"a{suffix}"
    write_usd(path, scene)
    back = read_usd(path)
    assert back.notes == () and encode_scene(back.scene) == encode_scene(scene)


def test_rows_of_materials_are_written_in_one_order() -> None:
    """Specs that Sdf copies are ordered by addresses, so that bytes differed between processes."""
    layer = new_layer(layout.ROOT)
    scene = tiny_scene()
    author_scene(layer, layout.ROOT, scene)
    orders = []
    for row in range(len(scene.materials)):
        order = list[str]()
        path = f"{layout.ROOT}/Materials/{layout.material_name(row)}"
        layer.Traverse(path, lambda spec, order=order: order.append(str(spec)))
        orders.append([spec.replace(path, "") for spec in order])
    assert len(orders) > 1 and all(order == orders[0] for order in orders)


def test_stage_says_units_and_lights_and_holds_no_path(tmp_path: Path) -> None:
    """A lens is in tenths of a metre; an emitter is a light, and glows on both sides.

    Validators would see a mistake.
    """
    scene = tiny_scene()
    stage = written(tmp_path, scene, "a.usda")
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert stage.GetDefaultPrim().GetPath() == "/Scene"
    text = (tmp_path / "a.usda").read_text()
    assert str(tmp_path) not in text and "@" not in text
    camera = UsdGeom.Camera.Get(stage, "/Scene/Cameras/camera_0").GetCamera()
    wanted = 0.018 / math.tan(math.radians(float(scene.fov_deg[0])) / 2)
    assert camera.focalLength / 10 == pytest.approx(wanted, rel=1e-6)
    light = stage.GetPrimAtPath("/Scene/Objects/light")
    assert light.HasAPI(UsdLux.MeshLightAPI)
    assert UsdLux.LightAPI(light).GetIntensityAttr().Get() == 1
    assert UsdGeom.Mesh(light).GetDoubleSidedAttr().Get() is True
    assert light.GetAttribute("trilight:visibleToCamera").Get() is False
    floor = stage.GetPrimAtPath("/Scene/Objects/floor")
    assert not floor.HasAPI(UsdLux.MeshLightAPI)
    assert floor.GetAttribute("trilight:licence").Get() == "CC0-1.0"
    stage.ClearDefaultPrim()
    assert errors_of(stage)


def test_materials_are_bound_by_subsets_and_say_the_same_in_openpbr(tmp_path: Path) -> None:
    """What the preview says, test_foreign_scene.py reads as a stranger does."""
    scene = odd_scene()
    stage = written(tmp_path, scene)
    for prim in stage.Traverse():
        if not prim.IsA(UsdGeom.Mesh):
            continue
        subsets = UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets()
        rows = np.array(prim.GetAttribute("trilight:faceRows").Get())
        bound = sorted(i for s in subsets for i in s.GetIndicesAttr().Get())
        assert bound == list(range(len(rows)))
        for subset in subsets:
            material = UsdShade.MaterialBindingAPI(subset).ComputeBoundMaterial()[0]
            (row,) = set(scene.material_index[rows[list(subset.GetIndicesAttr().Get())]])
            assert_material(material, scene.materials[row])


def assert_material(material: Any, values: np.ndarray) -> None:
    openpbr = material.ComputeSurfaceSource("mtlx")[0]
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


@pytest.mark.parametrize("suffix", WRITTEN_USD_SUFFIXES)
def test_a_shard_shows_one_scene_at_a_time(tmp_path: Path, suffix: str) -> None:
    scenes = [tiny_scene(), odd_scene(), bumpy_scene()]
    scenes += [tiny_scene(environment=sky) for sky in (smooth(), None, smooth(is_seen=True))]
    scenes += [textured_scene(seed) for seed in (0, 1, 0)]
    kept = {f"{row:09d}": scene for row, scene in enumerate(scenes, 1)}
    write_usd_shard(tmp_path / f"s{suffix}", kept.items())
    stage = Usd.Stage.Open(str(tmp_path / f"s{suffix}"))
    assert errors_of(stage) == []
    for key, scene in kept.items():
        stage.GetPrimAtPath("/Scenes").GetVariantSet("scene").SetVariantSelection(key)
        meshes = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
        assert len(meshes) == len(set(scene.object_index))
        found = read_usd(tmp_path / f"s{suffix}", key)
        assert encode_scene(found.scene) == encode_scene(scene)
    assert usd_keys(tmp_path / f"s{suffix}") == list(kept)
    if suffix != ".usdz":  # one content, one file
        assert len(list(tmp_path.glob("sky-*.exr"))) == 1
        assert len(list(tmp_path.glob("texture-*.png"))) == 3
    with pytest.raises(TrilightError, match="no scene 000000033; expected one of 000000001"):
        read_usd(tmp_path / f"s{suffix}", "000000033")


def set_default(path: str, value: Any) -> Callable[[Any], None]:
    return lambda layer: setattr(layer.GetObjectAtPath(path), "default", value)


def test_what_was_changed_or_added_is_no_longer_ours(tmp_path: Path) -> None:
    edits: list[Callable[[Any], object]] = [
        set_default("/Scene/Objects/floor.points", [(0, 0, 0)] * 4),
        set_default("/Scene/Objects/light.inputs:intensity", 3.0),
        set_default("/Scene/Cameras/camera_0.focalLength", 3.0),
        lambda layer: layer.GetObjectAtPath("/Scene/Objects/floor").SetInfo("active", False),
        lambda layer: layer.GetObjectAtPath("/Scene/Objects/floor").SetInfo("instanceable", True),
        lambda layer: UsdLux.SphereLight.Define(Usd.Stage.Open(layer), "/Scene/Objects/more"),
    ]
    for folder, edit in with_folders(tmp_path, edits):
        assert edited_layer(folder, tiny_scene(), edit).notes, folder.name


def test_what_is_not_written(tmp_path: Path) -> None:
    odd = (SceneObject(name="a\0b", kind="shell"), tiny_scene().objects[1])
    long = np.zeros((1, 8193, 3), np.uint8)
    long[0, 0] = 1
    too_large = textured_scene(0, Texture(texels=long), number_texture())
    for scene, name, message in (
        (tiny_scene(), "a.usd", "ends in .usda, .usdc, .usdz"),
        (tiny_scene(fov_deg=np.array([45, 181], np.float32)), "a.usda", "fov_deg"),
        (tiny_scene(objects=odd), "a.usda", "a character that USD cannot store"),
        (too_large, "a.usda", "texture: 8193 x 1 texels; expected at most 8192"),
    ):
        with pytest.raises(TrilightError, match=message):
            write_usd(tmp_path / name, scene)
        assert not list(tmp_path.iterdir())


def _sky(scene: Scene) -> Environment:
    assert scene.environment is not None
    return scene.environment


def test_a_normal_map_is_an_input_that_usd_defines(tmp_path: Path) -> None:
    scene = bumpy_scene()
    stage = written(tmp_path, scene, "a.usda")
    shader = UsdShade.Shader(stage.GetPrimAtPath(f"/Scene/Materials/material_{FLOOR}/Preview"))
    (source,) = UsdShade.Utils.GetValueProducingAttributes(shader.GetInput("normal"))
    node = UsdShade.Shader(source.GetPrim())
    stated = {name: node.GetInput(name).Get() for name in ("scale", "bias", "sourceColorSpace")}
    assert stated == {"scale": (2, 2, 2, 1), "bias": (-1, -1, -1, 0), "sourceColorSpace": "raw"}
    picture = np.asarray(Image.open(tmp_path / node.GetInput("file").Get().path))
    assert np.array_equal(picture[::-1], scene.textures[2].texels)
    assert not list_lost_members(scene, FORMATS[".usda"].carried)
    assert "normal_textures" in " ".join(list_lost_members(scene, FORMATS[".h5"].carried))
    dropped = drop_uncarried_maps(scene, FORMATS[".h5"].carried)
    assert scene_digest(dropped) == scene_digest(textured_scene())


def test_other_programs_find_each_pole_where_we_have_it(tmp_path: Path) -> None:
    """By the convention of USD alone: the middle is +Z of the dome, a quarter +X, the top +Y."""
    turn = uniform_rotation(np.random.default_rng(2)).astype(np.float32)
    turned = six_poles(rotation=turn)
    stage = written(tmp_path, tiny_scene(environment=turned), "a.usda")
    dome = UsdLux.DomeLight(stage.GetPrimAtPath("/Scene/Environment"))
    matrix = dome.ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    places = {
        "+Z": (0.5, 0.5),
        "+X": (0.25, 0.5),
        "-X": (0.75, 0.5),
        "+Y": (0.5, 1),
        "-Y": (0.5, 0),
    }
    radiance = turned.radiance_rgb
    for name, (u, v) in places.items():
        world = np.array(matrix.TransformDir(Gf.Vec3d(*map(float, POLES[name]))))
        row = min(int((1 - v) * len(radiance)), len(radiance) - 1)
        column = int(u * 2 * len(radiance))
        assert environment_values(turned, world) == pytest.approx(radiance[row, column])


def edited(path: Path, edit: Callable[[Usd.Stage, UsdLux.DomeLight], object]) -> LoadedScene:
    """Return our six poles, with their dome edited."""
    write_usd(path, tiny_scene(environment=six_poles()))
    stage = Usd.Stage.Open(str(path))
    edit(stage, UsdLux.DomeLight(stage.GetPrimAtPath("/Scene/Environment")))
    stage.Save()
    return read_usd(path)


@pytest.mark.parametrize("up", ["Y", "Z"])
def test_a_foreign_dome_stands_by_the_axes_of_usd(tmp_path: Path, up: str) -> None:
    """Unturned: the top of the picture is +Y of the stage, whichever axis is up there."""

    def turn(stage: Usd.Stage, light: UsdLux.DomeLight) -> None:
        light.GetPrim().GetAttribute("xformOp:transform").Set(Gf.Matrix4d(1))
        stage.SetMetadata("upAxis", up)
        light.GetIntensityAttr().Set(2.0)
        light.CreateExposureAttr(1.0)

    found = edited(tmp_path / "a.usda", turn)
    assert found.notes
    of_picture = {"top": "+Z", "middle": "+X", "quarter": "+Y"}  # its colours, by our own axes
    world = {"Z": {"top": (0, 1, 0), "middle": (0, 0, 1), "quarter": (1, 0, 0)},
             "Y": {"top": (0, 0, 1), "middle": (0, -1, 0), "quarter": (1, 0, 0)}}[up]  # fmt: skip
    for part, pole in of_picture.items():
        value = environment_values(_sky(found.scene), world[part])
        assert value == pytest.approx(4 * np.array(COLOURS[pole]), rel=1e-5), part


def test_a_dome_without_a_file_is_even_and_may_be_the_only_light(tmp_path: Path) -> None:
    def clear(stage: Usd.Stage, light: UsdLux.DomeLight) -> None:
        light.GetTextureFileAttr().Clear()
        light.CreateColorAttr(Gf.Vec3f(1.0, 0.5, 0.25))
        stage.GetPrimAtPath("/Scene/Objects/light").SetActive(False)

    found = edited(tmp_path / "a.usda", clear).scene
    assert not found.triangle_emits.any()
    np.testing.assert_allclose(_sky(found).radiance_rgb, [[[1, 0.5, 0.25]] * 2])


def test_a_map_is_read_or_named(tmp_path: Path) -> None:
    texels = np.full((2, 4, 4), (64, 128, 32, 130), np.uint8)
    (tmp_path / "a.hdr").write_bytes(radiance_hdr(texels, header="EXPOSURE=2\n"))
    Image.fromarray(np.full((2, 4, 3), 188, np.uint8)).save(tmp_path / "a.png")
    (tmp_path / "text.exr").write_bytes(b"no picture")
    wide = encode_channels({"RGB": np.ones((4, 4, 3), np.float32)})
    (tmp_path / "wide.exr").write_bytes(wide)

    def read(name: str) -> LoadedScene:
        asset = Sdf.AssetPath(f"./{name}")
        path = tmp_path / f"{name}.usda"
        return edited(path, lambda stage, light: light.GetTextureFileAttr().Set(asset))

    wrong = {"missing.exr": "is missing", "text.exr": "is not read", "wide.exr": "shape"}
    for name, said in wrong.items():
        found = read(name)
        assert found.scene.environment is None, name
        assert any(said in text for text in found.notes), name
    for name, rgb in (("a.hdr", [0.5, 1, 0.25]), ("a.png", linear_from_srgb8()[[188] * 3])):
        radiance = _sky(read(name).scene).radiance_rgb
        np.testing.assert_allclose(radiance, np.broadcast_to(rgb, (2, 4, 3)), rtol=1e-6)


def _all_textured() -> Scene:
    """Every column textured, of 8 bits and of float32, and two materials that share textures."""
    rng = np.random.default_rng(5)
    diffuse = Texture(texels=rng.uniform(0, 0.5, (5, 3, 3)).astype(np.float32))
    specular = Texture(texels=rng.integers(0, 127, (2, 7, 3), np.uint8))
    number = Texture(texels=rng.integers(0, 256, (4, 4, 1), np.uint8), is_srgb=True,
                     source=MapSource(name='a "b" ü', licence="MIT", attribution="Ö"))  # fmt: skip
    base = textured_scene()
    index = np.array([[0, 1, 2], [-1, -1, -1], [-1, -1, 2]], np.int32)
    return dataclasses.replace(
        base,
        materials=np.concatenate([base.materials, base.materials[:1]]),
        material_index=np.array([FLOOR, 2, LIGHT], np.uint16),
        textures=(diffuse, specular, number),
        material_textures=index,
    )


@pytest.mark.parametrize("suffix", WRITTEN_USD_SUFFIXES)
def test_there_and_back_is_exact_and_valid(tmp_path: Path, suffix: str) -> None:
    """Bytes as bytes and floats as floats; a sun above what half floats hold, turned anyhow."""
    scenes = [odd_scene(), textured_scene(), textured_scene(environment=sky()), _all_textured()]
    turn = uniform_rotation(np.random.default_rng(1)).astype(np.float32)
    skies = (one_sun(1e6, rotation=turn), six_poles(is_seen=True))
    scenes += [tiny_scene(environment=each) for each in skies]
    for folder, scene in with_folders(tmp_path, scenes):
        assert_usd_keeps_all(scene, folder, suffix)
        path = folder / f"again{suffix}"
        before = path.read_bytes()
        assert usd_keys(path) == [""]
        assert_usd_keeps_all(read_usd(path).scene, folder, suffix)
        assert path.read_bytes() == before
        has_files = suffix != ".usdz" and (scene.textures or scene.environment)
        assert (len(list(folder.iterdir())) > 1) == bool(has_files)


def test_one_colour_is_no_texture(tmp_path: Path) -> None:
    one = Texture(texels=np.full((3, 3, 3), 128, np.uint8), is_srgb=True)
    scene = textured_scene(0, one, number_texture())
    assert_usd_keeps_all(scene, tmp_path, ".usda")
    assert not list(tmp_path.glob("*.png"))


def test_other_programs_find_every_corner_where_we_have_it(tmp_path: Path) -> None:
    """By the words of USD alone: `st` of a corner, v up, the top row of a picture at v = 1.

    A textured material has no constant OpenPBR that renderers of MaterialX would prefer.
    """
    texels = np.array([[[200, 0, 0], [0, 200, 0]], [[0, 0, 200], [90, 90, 0]]], np.uint8)
    scene = textured_scene(0, Texture(texels=texels, is_srgb=True), number_texture())
    stage = written(tmp_path, scene, "a.usda")
    shader = UsdShade.Shader(stage.GetPrimAtPath("/Scene/Materials/material_0/DiffuseTexture"))
    assert shader.GetInput("sourceColorSpace").Get() == "sRGB"
    assert [shader.GetInput(f"wrap{axis}").Get() for axis in "ST"] == ["repeat", "repeat"]
    picture = np.asarray(Image.open(tmp_path / shader.GetInput("file").Get().path))
    for u, v, column, row in ((0.25, 0.25, 0, 0), (0.75, 0.25, 1, 0), (0.25, 0.75, 0, 1)):
        assert (picture[int((1 - v) * 2), int(u * 2)] == texels[row, column]).all()
    primvar = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/Scene/Objects/floor")).GetPrimvar("st")
    assert primvar.GetInterpolation() == "faceVarying"
    assert np.array_equal(np.array(primvar.Get()), scene.uv[:6])  # type: ignore[index]
    shaders = {FLOOR: "UsdPreviewSurface", LIGHT: "ND_open_pbr_surface_surfaceshader"}
    for row, expected in shaders.items():
        material = UsdShade.Material(stage.GetPrimAtPath(f"/Scene/Materials/material_{row}"))
        assert material.ComputeSurfaceSource("mtlx")[0].GetShaderId() == expected


def test_files_that_were_changed_are_read_as_they_are_now(tmp_path: Path) -> None:
    """The scene is no longer the one that was written, and the digest says so."""
    path = tmp_path / "a.usda"
    write_usd(path, textured_scene(environment=six_poles()))
    layer = Sdf.Layer.FindOrOpen(str(path))
    shader = layer.GetPrimAtPath("/Scene/Materials/material_0/Preview")
    shader.attributes["inputs:diffuseColor"].connectionPathList.ClearEdits()
    layer.Export(str(tmp_path / "b.usda"))
    assert read_usd(tmp_path / "b.usda").notes, "a connection was edited"
    (picture,), (map_file,) = tmp_path.glob("texture-*.png"), tmp_path.glob("sky-*.exr")
    map_file.write_bytes(encode_channels({"RGB": np.full((2, 4, 3), 7, np.float32)}))
    Image.fromarray(np.full((4, 6, 3), 255, np.uint8)).save(picture)
    found = read_usd(path)
    assert any("diffuse was changed since" in text for text in found.notes)
    assert (_sky(found.scene).radiance_rgb == 7).all()
