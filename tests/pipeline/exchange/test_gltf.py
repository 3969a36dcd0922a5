"""glTF as a scene: places, colours at corners, Fresnel, what is lost; GLB as it is written."""

import base64
import dataclasses
import itertools
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from pipeline.exchange.convert import convert_scene, write_scene
from pipeline.exchange.gltf import encode_mesh_glb, encode_scene_glb, read_gltf
from pipeline.exchange.reader import load_source, scene_source
from pipeline.exchange.textured_triangles import LoadedScene
from storage.conventions import linear_from_srgb8
from storage.errors import TrilightError
from storage.records.asset import Level
from storage.records.lookup import environment_values
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS, SPECULAR
from tests import textured_by_hand as textured
from tests.for_each import for_each
from tests.pipeline.assets.meshes_by_hand import geometry, prepare, write_glb
from tests.pipeline.assets.source_materials import textured_kit as kit
from tests.pipeline.exchange.exchange_kit import row_at
from tests.scenes_by_hand import FLOOR, tiny_scene

RED, GREEN, BLUE, GREY = (255, 0, 0), (0, 255, 0), (0, 0, 255), (128, 128, 128)
PICTURE = np.array([[RED, GREEN], [BLUE, GREY]], np.uint8)
"""The top row first: red is the upper left corner, at (-1, 1)."""

FLOOR_MESH = dataclasses.replace(kit.SQUARE, positions=2 * kit.SQUARE.positions[:, [0, 2, 1]])
"""Its corners are (-1, -1), (1, -1), (1, 1), (-1, 1)."""


def quad(
    *pictures: bytes | str, uv: Any = kit.UV_UP, material: Any = None, **changes: Any
) -> tuple[dict[str, Any], bytes]:
    """Return tree and buffer of a textured floor, whose first picture is `PICTURE` by default."""
    first, *more = pictures or (kit.picture_bytes(PICTURE),)
    tree, buffer = kit.textured_tree(first, uv, FLOOR_MESH)
    tree["asset"]["copyright"] = "A. Maker"
    tree["nodes"][0]["name"] = "floor"
    tree["materials"][0]["pbrMetallicRoughness"]["roughnessFactor"] = 0.5
    tree["materials"][0] |= material or {}
    for picture in more:
        assert isinstance(picture, bytes)
        tree["images"].append({"uri": "data:;base64," + base64.b64encode(picture).decode()})
        tree["textures"].append({"source": len(tree["textures"])})
    return {**tree, **changes}, buffer


def saved(folder: Path, tree: dict[str, Any], buffer: bytes) -> LoadedScene:
    return read_gltf(write_glb(folder / "a.glb", tree, buffer))


def read(folder: Path, *pictures: bytes | str, **changes: Any) -> LoadedScene:
    return saved(folder, *quad(*pictures, **changes))


CODED = 0.005
"""Half a step of 8 sRGB-encoded bits is at most 0.0045 in linear light."""


def test_textures_stand_upright_and_rights_are_kept(tmp_path: Path) -> None:
    """Objects and scenes are the same: tests/pipeline/foreign/test_mesh_formats.py."""
    scene = read(tmp_path).scene
    assert row_at(scene, -0.5, 0.5)[:3] == pytest.approx(kit.shown(RED), abs=CODED)
    assert row_at(scene, -0.5, 0.5)[3:7] == pytest.approx([kit.F, kit.F, kit.F, 0.5], abs=1e-6)
    assert scene.vertex_normals == pytest.approx(np.tile([0, 0, 1], (4, 1)), abs=1e-6)
    assert scene.objects[0].attribution == "A. Maker"
    loaded = load_source(scene_source(str(tmp_path / "a.glb")))
    assert any("no light" in note for note in loaded.notes)


def test_cameras_lights_and_emission(tmp_path: Path) -> None:
    lens = {"type": "perspective", "perspective": {"yfov": 0.5, "aspectRatio": 1.0}}
    tree, buffer = quad(
        material={"emissiveFactor": [1, 0.5, 0],
                  "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 4}}},
        cameras=[lens],
        extensions={"KHR_lights_punctual": {"lights": [{"type": "point", "intensity": 3.0}]}},
    )  # fmt: skip
    light = {"KHR_lights_punctual": {"light": 0}}
    lamp = {"name": "lamp", "translation": [0, 3, 0], "extensions": light}
    tree["nodes"] += [{"camera": 0, "translation": [0, 2, 5]}, lamp]
    tree["scenes"][0]["nodes"] = [0, 1, 2]
    found = saved(tmp_path, tree, buffer)
    scene = found.scene
    assert scene.environment is None
    assert scene.c2w[0, :3, 3] == pytest.approx([0, -5, 2], abs=1e-6)
    assert scene.c2w[0, :3, 2] == pytest.approx([0, -1, 0], abs=1e-6), "it looks along +Y"
    assert scene.fov_deg[0] == pytest.approx(np.degrees(0.5))
    assert [entry.name for entry in scene.objects] == ["floor", "lamp"]
    rows = scene.materials[scene.material_index]
    assert rows[0, 7:10] == pytest.approx([4, 2, 0])
    own = scene.faces[scene.object_index == 1]
    a, b, c = np.moveaxis(scene.vertex_positions[own].astype(np.float64), 1, 0)
    cross = np.cross(b - a, c - a)
    outward = np.einsum("ti,ti->t", cross, a + b + c - 3 * np.array([0, 0, 3]))
    assert (outward > 0).all() and len(own) == 8
    seen = np.linalg.norm(cross, axis=1).sum() / 8
    assert rows[-1, 7] * seen == pytest.approx(3.0, rel=1e-5)  # candela, on average


def test_a_directional_light_is_a_sun_of_as_many_lux(tmp_path: Path) -> None:
    light = {"type": "directional", "intensity": 7.0, "color": [1, 0.5, 0]}
    tree, buffer = quad(extensions={"KHR_lights_punctual": {"lights": [light]}})
    turned = {"rotation": [-(0.5**0.5), 0, 0, 0.5**0.5]}  # its -z looks down glTF's -y
    tree["nodes"].append({**turned, "extensions": {"KHR_lights_punctual": {"light": 0}}})
    tree["scenes"][0]["nodes"] = [0, 1]
    sky = saved(tmp_path, tree, buffer).scene.environment
    assert sky is not None
    rng = np.random.default_rng(0)
    near = rng.normal(size=(200_000, 3)) * [0.02, 0.02, 0] + [0, 0, 1]
    density = np.exp(-np.square(near[:, :2]).sum(axis=1) / 2 / 0.02**2) / (2 * np.pi * 0.02**2)
    weight = (1 + np.square(near[:, :2]).sum(axis=1)) ** -2.0  # of the plane's area, seen from 0
    irradiance = (environment_values(sky, near) * (weight / density)[:, None]).mean(axis=0)
    assert irradiance == pytest.approx([7, 3.5, 0], rel=0.1)


def test_what_is_lost_is_said_once(tmp_path: Path) -> None:
    material = {
        "normalTexture": {"index": 0},
        "occlusionTexture": {"index": 0},
        "alphaMode": "BLEND",
        "emissiveFactor": [1, 1, 1],
        "emissiveTexture": {"index": 0},
        "extensions": {"KHR_materials_clearcoat": {"clearcoatFactor": 1}},
    }
    found = read(tmp_path, material=material, animations=[{}])
    lost = ("normal map", "occlusion", "transparency", "emission", "clearcoat", "animations")
    for words in lost:
        assert sum(words in text for text in found.notes) == 1, words
    files = convert_scene(
        scene_source(str(tmp_path / "a.glb")), tmp_path / "a.usda", budget=None,
        done=lambda finished, total: None,
    )  # fmt: skip
    assert any("normal map" in note for note in files.notes)
    assert not any("cannot hold textures" in note for note in files.notes)
    pictures = sorted(tmp_path.glob("texture-*.png"))
    assert pictures and files.files == (tmp_path / "a.usda", *pictures)


def test_a_missing_picture_leaves_the_factor_and_one_elsewhere_is_refused(tmp_path: Path) -> None:
    found = read(tmp_path, "gone.png")
    assert any("left out: 'gone.png'" in text for text in found.notes)
    assert row_at(found.scene, 0.5, 0.5)[:3] == pytest.approx([1 - kit.F] * 3, abs=1e-6)
    for uri in ("../a.png", "http://example.com/a.png", "/etc/hostname"):
        with pytest.raises(TrilightError, match=r"a\.glb: .*lies (outside|elsewhere)"):
            read(tmp_path, uri)


@for_each("value", [float("nan"), "red", -1, 2])
def test_factors_that_are_no_albedo_are_said(tmp_path: Path, value: Any) -> None:
    surface = {"metallicFactor": value, "baseColorFactor": [0.5, 0.5, 0.5, 1]}
    found = read(tmp_path, material={"pbrMetallicRoughness": surface})
    assert any("metallicFactor" in text for text in found.notes)


def test_a_mesh_without_coordinates_takes_the_mean_and_one_texel_is_a_constant(
    tmp_path: Path,
) -> None:
    found = read(tmp_path, uv=None)
    assert any("without texture coordinates" in text for text in found.notes)
    assert not found.scene.textures
    mean = linear_from_srgb8()[PICTURE].mean(axis=(0, 1)) * (1 - kit.F)
    assert found.scene.materials[0, :3] == pytest.approx(mean, abs=1e-5)
    one = read(tmp_path, kit.picture_bytes(PICTURE[:1, 1:])).scene
    assert not one.textures
    assert one.materials[0, :3] == pytest.approx(kit.shown(GREEN), abs=1e-6)
    # Coordinates that are not finite are refused.
    broken = kit.UV_UP.copy()
    broken[0, 0] = np.nan
    with pytest.raises(TrilightError, match="TEXCOORD_0 is not finite"):
        read(tmp_path, uv=broken)


@for_each("specular", [(0.2, 0.2, 0.2), (0, 0, 0), (0.4, 0.1, 0.3), (0.9, 0.5, 0.1)])
def test_a_scene_comes_back(tmp_path: Path, specular: tuple[float, float, float]) -> None:
    materials = tiny_scene().materials.copy()
    materials[FLOOR, DIFFUSE], materials[FLOOR, SPECULAR] = (0.1, 0.05, 0.3), specular
    scene = tiny_scene(materials=materials)
    write_scene(tmp_path / "a.glb", scene)
    found = read_gltf(tmp_path / "a.glb").scene
    assert found.num_triangles == scene.num_triangles
    for name in ("c2w", "fov_deg"):
        np.testing.assert_allclose(getattr(found, name), getattr(scene, name), atol=1e-6)
    for name in ("vertex_positions", "vertex_normals"):
        mine, theirs = (getattr(each, name)[each.faces] for each in (scene, found))
        np.testing.assert_allclose(theirs, mine, atol=1e-6)
    rows = found.materials[found.material_index]
    np.testing.assert_allclose(rows, scene.materials[scene.material_index], rtol=1e-5, atol=1e-5)
    assert [entry.name for entry in found.objects] == ["floor", "light"]
    assert [entry.kind for entry in found.objects] == ["object", "emitter"]


def test_textures_come_back_to_their_eight_bits_and_what_is_lost_is_said(tmp_path: Path) -> None:
    scene = textured.textured_scene(4, environment=textured.sky())
    lost = " ".join(write_scene(tmp_path / "a.glb", scene))
    for word in ("environment", "8 bits", "floors and walls", "provenance"):
        assert word in lost
    found = read_gltf(tmp_path / "a.glb").scene
    x, y, _ = scene.vertex_positions[scene.faces[0]].mean(axis=0)
    for columns, most in ((DIFFUSE, 0.01), (ROUGHNESS, 0.003)):
        wanted, got = (row_at(each, x, y)[columns] for each in (scene, found))
        np.testing.assert_allclose(got, wanted, atol=most)
    assert found.materials[found.material_index[2], EMISSION].tolist() == [100, 100, 100]


def test_two_textured_albedos_of_different_widths_are_one_grid(tmp_path: Path) -> None:
    one, two = textured.colour_texture(1), textured.colour_texture(2)
    glossy = dataclasses.replace(one, texels=one.texels[::2] // 4)
    rough = textured.number_texture()
    wide = dataclasses.replace(two, texels=two.texels // 2)
    index = np.full((2, 3), -1, np.int32)
    index[FLOOR] = [0, 1, 2]
    scene = textured.textured_scene(0, wide, glossy, rough, material_textures=index)
    write_scene(tmp_path / "a.glb", scene)
    found = read_gltf(tmp_path / "a.glb").scene
    row = found.material_index[0]
    kept = scene.materials[FLOOR]
    assert found.materials[row, ROUGHNESS] == pytest.approx(rough.mean[0], abs=0.01)
    assert found.materials[row, SPECULAR] == pytest.approx(glossy.mean, abs=0.01), kept


def test_a_stranger_reads_it(tmp_path: Path) -> None:
    """trimesh, which knows nothing of ours, sees the triangles with +Y up, and the normal map."""
    scene = textured.bumpy_scene()
    assert "normal" not in " ".join(write_scene(tmp_path / "a.glb", scene))
    loaded = trimesh.load_scene(tmp_path / "a.glb")
    seen: Any = loaded.to_geometry()
    assert len(seen.faces) == 3
    assert seen.bounds[1][1] == pytest.approx(2) and seen.bounds[0][1] == pytest.approx(0)
    maps = [mesh.visual.material.normalTexture for mesh in loaded.geometry.values()]
    (found,) = (np.asarray(each.convert("RGB")) for each in maps if each is not None)
    assert np.array_equal(found[::-1], scene.textures[2].texels)


def test_the_file_keeps_the_laws_of_its_format() -> None:
    data = encode_scene_glb(textured.textured_scene())
    magic, version, length, head = struct.unpack("<4sIII", data[:16])
    assert (magic, version, length) == (b"glTF", 2, len(data))
    tree = json.loads(data[20 : 20 + head])
    (size,) = struct.unpack("<I", data[20 + head : 24 + head])
    assert tree["buffers"] == [{"byteLength": size}] or size - tree["buffers"][0]["byteLength"] < 4
    for view in tree["bufferViews"]:
        assert view["byteOffset"] % 4 == 0
        assert view["byteOffset"] + view["byteLength"] <= tree["buffers"][0]["byteLength"]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            points = tree["accessors"][primitive["attributes"]["POSITION"]]
            assert len(points["min"]) == len(points["max"]) == 3
    for material in tree["materials"]:
        assert max(material.get("emissiveFactor", [0])) <= 1
        assert max(material["pbrMetallicRoughness"].get("baseColorFactor", [0])) <= 1
    assert textured.corner_uv(textured.textured_scene()).shape[1] == 2


STEPS = 0.03
"""The texture is resampled once more, and rounded to 8 bits as base colour and as diffuse part."""


def glb_of(path: Path, level: Level) -> Path:
    skin = level.skin
    assert skin is not None
    path.write_bytes(encode_mesh_glb(level.positions, level.faces, skin.uv, skin.textures))
    return path


def test_colours_and_triangles_come_back(tmp_path: Path) -> None:
    asset = prepare(kit.textured_glb(tmp_path / "a.glb", kit.picture_bytes(kit.CORNERS)), kit.KEEP)
    again = prepare(glb_of(tmp_path / "b.glb", asset.levels[0]), kit.KEEP)
    assert geometry(again) == geometry(asset)
    for place in kit.QUARTERS:
        for column in range(3):
            before, after = kit.seen_at(asset, *place, column), kit.seen_at(again, *place, column)
            assert np.abs(before - after).max() < STEPS, (place, column)


def test_metal_comes_back_as_the_same_light(tmp_path: Path) -> None:
    """Not as a metal: what both lobes reflect is what we keep."""
    picture = kit.picture_bytes(np.array([[[9, 51, 0], [9, 204, 255]]], np.uint8))
    tree, buffer = kit.textured_tree(picture)
    metal = tree["materials"][0]["pbrMetallicRoughness"]
    metal |= {"metallicRoughnessTexture": metal.pop("baseColorTexture"), "metallicFactor": 1}
    metal["baseColorFactor"] = [0.9, 0.4, 0.2, 1]
    asset = prepare(write_glb(tmp_path / "a.glb", tree, buffer), kit.KEEP)
    again = prepare(glb_of(tmp_path / "b.glb", asset.levels[0]), kit.KEEP)
    for right, column in itertools.product((-0.25, 0.25), range(3)):
        before, after = kit.seen_at(asset, right, 0, column), kit.seen_at(again, right, 0, column)
        assert np.abs(before - after).max() < STEPS, (right, column)
