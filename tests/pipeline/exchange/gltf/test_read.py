"""glTF as a scene: places, colours at corners, Fresnel, what is lost; GLB as it is written."""

import base64
import dataclasses
import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image

from pipeline.exchange.convert import convert_scene, write_scene
from pipeline.exchange.gltf.read import GltfScene, read_gltf
from pipeline.exchange.gltf.write import encode_scene_glb
from pipeline.exchange.open_scene import load_source, scene_source
from storage.conventions import linear_from_srgb8
from storage.errors import TrilightError
from storage.records.lookup import environment_values, texture_values
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS, SPECULAR
from storage.records.scene import Scene
from tests.for_each import for_each
from tests.pipeline.exchange.exchange_kit import row_at
from tests.scenes_by_hand import FLOOR, tiny_scene
from tests.textured_by_hand import colour_texture, corner_uv, number_texture, sky, textured_scene

POSITIONS = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], np.float32)
"""A floor in glTF's axes: +Y up. In ours, the corners are (-1, -1), (1, -1), (1, 1), (-1, 1)."""

UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
"""v goes down: the first corner is the lower left one of the picture."""

RED, GREEN, BLUE, GREY = (255, 0, 0), (0, 255, 0), (0, 0, 255), (128, 128, 128)
PICTURE = np.array([[RED, GREEN], [BLUE, GREY]], np.uint8)
"""The top row first: red is the upper left corner, at (-1, 1)."""


def png(pixels: NDArray[np.uint8]) -> str:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG")
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode()


def quad(**changes: Any) -> dict[str, Any]:
    """Return the tree of a textured quad; `uv`, `pictures`, `material` and `node` may be others."""
    uv = changes.pop("uv", UV)
    arrays: list[NDArray[Any]] = [POSITIONS, np.array([0, 1, 2, 0, 2, 3], np.uint16)]
    arrays += [] if uv is None else [uv]
    data = b"".join(array.tobytes() for array in arrays)
    ends = np.cumsum([array.nbytes for array in arrays])
    attributes = {"POSITION": 0} | ({} if uv is None else {"TEXCOORD_0": 2})
    kinds = [(5126, "VEC3"), (5123, "SCALAR"), (5126, "VEC2")]
    pictures = changes.pop("pictures", [png(PICTURE)])
    material = changes.pop("material", {})
    surface = {"metallicFactor": 0, "roughnessFactor": 0.5, "baseColorTexture": {"index": 0}}
    return {
        "asset": {"version": "2.0", "copyright": "A. Maker"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "floor", **changes.pop("node", {})}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 1, "material": 0}]}],
        "materials": [{"name": "m", "pbrMetallicRoughness": surface, **material}],
        "textures": [{"source": row, "sampler": 0} for row in range(len(pictures))],
        "samplers": [changes.pop("sampler", {})],
        "images": [{"uri": uri} for uri in pictures],
        "buffers": [
            {"byteLength": len(data), "uri": "data:;base64," + base64.b64encode(data).decode()}
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(end - array.nbytes), "byteLength": array.nbytes}
            for array, end in zip(arrays, ends, strict=True)
        ],
        "accessors": [
            {"bufferView": row, "componentType": kinds[row][0], "type": kinds[row][1],
             "count": array.size if kinds[row][1] == "SCALAR" else len(array)}
            for row, array in enumerate(arrays)
        ],
        **changes,
    }  # fmt: skip


def write_gltf(folder: Path, tree: dict[str, Any], name: str = "a.gltf") -> Path:
    (folder / name).write_text(json.dumps(tree))
    return folder / name


F = 0.04 + 0.96 / 21
"""What a dielectric of index 1.5 reflects: F0, and the mean of Schlick's rise to 1."""


def read(folder: Path, **changes: Any) -> GltfScene:
    return read_gltf(write_gltf(folder, quad(**changes)), "CC0-1.0")


def diffuse_of(srgb: tuple[int, int, int]) -> np.ndarray:
    return np.asarray(linear_from_srgb8()[list(srgb)] * (1 - F))


CORNERS = {(-0.5, 0.5): RED, (0.5, 0.5): GREEN, (-0.5, -0.5): BLUE, (0.5, -0.5): GREY}
"""Centres of the texels on the floor: where the picture's own top is +Y."""

CODED = 0.005
"""Half a step of 8 sRGB-encoded bits is at most 0.0045 in linear light."""


def test_every_texel_lies_where_gltf_puts_it(tmp_path: Path) -> None:
    """A mirrored u, a flipped v or a turned floor would exchange colours; sRGB is decoded."""
    scene = read(tmp_path).scene
    for (x, y), colour in CORNERS.items():
        found = row_at(scene, x, y)
        assert found[:3] == pytest.approx(diffuse_of(colour), abs=CODED), colour
        assert found[3:7] == pytest.approx([F, F, F, 0.5], abs=1e-6)
    assert scene.vertex_normals == pytest.approx(np.tile([0, 0, 1], (4, 1)), abs=1e-6)
    assert scene.objects[0].attribution == "A. Maker"
    loaded = load_source(scene_source(str(tmp_path / "a.gltf")))
    assert any("no light" in note for note in loaded.notes)


def test_transforms_of_nodes_and_of_textures(tmp_path: Path) -> None:
    """A quarter turn counter-clockwise of the coordinates turns the picture clockwise."""
    moved = {"rotation": np.pi / 2, "offset": [0, 1]}
    info = {"index": 0, "extensions": {"KHR_texture_transform": moved}}
    surface = {"metallicFactor": 0, "baseColorTexture": info}
    node = {"translation": [0, 0, -2], "scale": [2, 2, 2]}
    scene = read(tmp_path, material={"pbrMetallicRoughness": surface}, node=node).scene
    assert scene.vertex_positions.min(axis=0) == pytest.approx([-2, 0, 0], abs=1e-6)
    turned = {(-1, 3): BLUE, (1, 3): RED, (1, 1): GREEN, (-1, 1): GREY}
    for (x, y), colour in turned.items():
        assert row_at(scene, x, y)[:3] == pytest.approx(diffuse_of(colour), abs=CODED), colour


def test_metal_is_blue_and_roughness_green(tmp_path: Path) -> None:
    mixed = np.array([[[9, 255, 0], [9, 51, 255]]], np.uint8)
    surface = {"baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 1}}
    tree = {
        "pictures": [png(PICTURE[:1]), png(mixed)],
        "material": {"pbrMetallicRoughness": surface},
    }
    scene = read(tmp_path, **tree).scene
    plain, metal = row_at(scene, -0.5, 0), row_at(scene, 0.5, 0)
    assert plain[:3] == pytest.approx(diffuse_of(RED), abs=CODED) and plain[6] == 1
    assert metal[:3] == pytest.approx([0, 0, 0], abs=CODED) and metal[6] == pytest.approx(0.2)
    assert metal[3:6] == pytest.approx(np.array(GREEN) / 255 * 20 / 21 + 1 / 21, abs=CODED)


def test_cameras_lights_and_emission(tmp_path: Path) -> None:
    lens = {"type": "perspective", "perspective": {"yfov": 0.5, "aspectRatio": 1.0}}
    tree = quad(
        material={"emissiveFactor": [1, 0.5, 0],
                  "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 4}}},
        cameras=[lens],
        extensions={"KHR_lights_punctual": {"lights": [{"type": "point", "intensity": 3.0}]}},
    )  # fmt: skip
    tree["nodes"] += [
        {"camera": 0, "translation": [0, 2, 5]},
        {
            "name": "lamp",
            "translation": [0, 3, 0],
            "extensions": {"KHR_lights_punctual": {"light": 0}},
        },
    ]
    tree["scenes"][0]["nodes"] = [0, 1, 2]
    found = read_gltf(write_gltf(tmp_path, tree), "CC0-1.0")
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
    tree = quad(extensions={"KHR_lights_punctual": {"lights": [light]}})
    turned = {"rotation": [-(0.5**0.5), 0, 0, 0.5**0.5]}  # its -z looks down glTF's -y
    tree["nodes"].append({**turned, "extensions": {"KHR_lights_punctual": {"light": 0}}})
    tree["scenes"][0]["nodes"] = [0, 1]
    sky = read_gltf(write_gltf(tmp_path, tree), "CC0-1.0").scene.environment
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
    for words in (
        "normal map",
        "occlusion",
        "transparency",
        "emission",
        "clearcoat",
        "animations",
    ):
        assert sum(words in text for text in found.lost) == 1, words
    files = convert_scene(
        scene_source(str(tmp_path / "a.gltf")), tmp_path / "a.usda", budget=None,
        done=lambda finished, total: None,
    )  # fmt: skip
    assert any("normal map" in note for note in files.notes)
    assert not any("cannot hold textures" in note for note in files.notes)
    pictures = sorted(tmp_path.glob("texture-*.png"))
    assert pictures and files.files == (tmp_path / "a.usda", *pictures)


def test_a_missing_picture_leaves_the_factor(tmp_path: Path) -> None:
    found = read(tmp_path, pictures=["gone.png"])
    assert any("left out: 'gone.png'" in text for text in found.lost)
    assert row_at(found.scene, 0.5, 0.5)[:3] == pytest.approx([1 - F] * 3, abs=1e-6)


@pytest.mark.parametrize("uri", ["../a.png", "http://example.com/a.png", "/etc/hostname"])
def test_pictures_elsewhere_are_refused(tmp_path: Path, uri: str) -> None:
    with pytest.raises(TrilightError, match=r"a\.gltf: .*lies (outside|elsewhere)"):
        read(tmp_path, pictures=[uri])


def test_a_mesh_without_coordinates_takes_the_mean_and_one_texel_is_a_constant(
    tmp_path: Path,
) -> None:
    found = read(tmp_path, uv=None)
    assert any("without texture coordinates" in text for text in found.lost)
    assert not found.scene.textures
    mean = linear_from_srgb8()[PICTURE].mean(axis=(0, 1)) * (1 - F)
    assert found.scene.materials[0, :3] == pytest.approx(mean, abs=1e-5)
    one = read(tmp_path, pictures=[png(PICTURE[:1, 1:])]).scene
    assert not one.textures
    assert one.materials[0, :3] == pytest.approx(diffuse_of(GREEN), abs=1e-6)


@for_each("value", [float("nan"), "red", -1, 2])
def test_factors_that_are_no_albedo(tmp_path: Path, value: Any) -> None:
    surface = {"metallicFactor": value, "baseColorFactor": [0.5, 0.5, 0.5, 1]}
    found = read(tmp_path, material={"pbrMetallicRoughness": surface})
    assert any("metallicFactor" in text for text in found.lost)


def test_coordinates_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    broken = UV.copy()
    broken[0, 0] = np.nan
    with pytest.raises(TrilightError, match="TEXCOORD_0 is not finite"):
        read(tmp_path, uv=broken)


@for_each(
    "damage",
    [
        {"textures": []},
        {"materials": [[]]},
        {"accessors": []},
        {"meshes": [{}]},
        {"bufferViews": [{"buffer": 0, "byteLength": 10**9}] * 3},
    ],
)
def test_a_broken_tree_is_one_sentence(tmp_path: Path, damage: dict[str, Any]) -> None:
    with pytest.raises(TrilightError, match=r"^a\.gltf: "):
        read(tmp_path, **damage)


def there_and_back(folder: Path, scene: Scene) -> Scene:
    write_scene(folder / "a.glb", scene)
    return read_gltf(folder / "a.glb", "CC0-1.0").scene


@for_each("specular", [(0.2, 0.2, 0.2), (0, 0, 0), (0.4, 0.1, 0.3), (0.9, 0.5, 0.1)])
def test_a_scene_comes_back(tmp_path: Path, specular: tuple[float, float, float]) -> None:
    materials = tiny_scene().materials.copy()
    materials[FLOOR, DIFFUSE], materials[FLOOR, SPECULAR] = (0.1, 0.05, 0.3), specular
    scene = tiny_scene(materials=materials)
    found = there_and_back(tmp_path, scene)
    assert found.num_triangles == scene.num_triangles
    for name in ("c2w", "fov_deg"):
        np.testing.assert_allclose(getattr(found, name), getattr(scene, name), atol=1e-6)
    mine, theirs = (each.vertex_positions[each.faces] for each in (scene, found))
    np.testing.assert_allclose(theirs, mine, atol=1e-6)
    mine, theirs = (each.vertex_normals[each.faces] for each in (scene, found))
    np.testing.assert_allclose(theirs, mine, atol=1e-6)
    rows = found.materials[found.material_index]
    np.testing.assert_allclose(rows, scene.materials[scene.material_index], rtol=1e-5, atol=1e-5)
    assert [entry.name for entry in found.objects] == ["floor", "light"]
    assert [entry.kind for entry in found.objects] == ["object", "emitter"]


def _looked_up(scene: Scene, column: int) -> NDArray[np.float64]:
    """Return what the texture of a column says in the middle of the first triangle."""
    assert scene.uv is not None and scene.material_textures is not None
    middle = scene.uv.reshape(-1, 3, 2)[0].mean(axis=0)
    row = scene.material_textures[scene.material_index[0], column]
    return texture_values(scene.textures[row], middle)


def test_textures_come_back_to_their_eight_bits(tmp_path: Path) -> None:
    scene = textured_scene(4)
    found = there_and_back(tmp_path, scene)
    for column, most in ((0, 0.01), (2, 0.003)):
        wanted, got = (_looked_up(each, column) for each in (scene, found))
        np.testing.assert_allclose(got, wanted, atol=most)
    assert found.materials[found.material_index[2], EMISSION].tolist() == [100, 100, 100]


def test_two_textured_albedos_of_different_widths_are_one_grid(tmp_path: Path) -> None:
    glossy = dataclasses.replace(colour_texture(1), texels=colour_texture(1).texels[::2] // 4)
    rough = number_texture()
    wide = dataclasses.replace(colour_texture(2), texels=colour_texture(2).texels // 2)
    index = np.full((2, 3), -1, np.int32)
    index[FLOOR] = [0, 1, 2]
    scene = textured_scene(0, wide, glossy, rough, material_textures=index)
    found = there_and_back(tmp_path, scene)
    row = found.material_index[0]
    kept = scene.materials[FLOOR]
    assert found.materials[row, ROUGHNESS] == pytest.approx(rough.mean[0], abs=0.01)
    assert found.materials[row, SPECULAR] == pytest.approx(glossy.mean, abs=0.01), kept


def test_what_a_glb_loses_is_said(tmp_path: Path) -> None:
    lost = " ".join(write_scene(tmp_path / "a.glb", textured_scene(environment=sky())))
    for word in ("environment", "8 bits", "floors and walls", "provenance"):
        assert word in lost
    dark = tiny_scene(
        materials=np.where(np.arange(10) >= 7, 0, tiny_scene().materials).astype(np.float32),
        objects=tuple(dataclasses.replace(e, kind="object") for e in tiny_scene().objects),
        environment=sky(),
    )
    with pytest.raises(TrilightError, match="only light is its environment"):
        write_scene(tmp_path / "b.glb", dark)


def test_a_stranger_reads_it(tmp_path: Path) -> None:
    """trimesh, which knows nothing of ours, sees the triangles with +Y up."""
    (tmp_path / "a.glb").write_bytes(encode_scene_glb(textured_scene()))
    seen: Any = trimesh.load_scene(tmp_path / "a.glb").to_geometry()
    assert len(seen.faces) == 3
    assert seen.bounds[1][1] == pytest.approx(2) and seen.bounds[0][1] == pytest.approx(0)


def test_the_file_keeps_the_laws_of_its_format() -> None:
    data = encode_scene_glb(textured_scene())
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
    assert corner_uv(textured_scene()).shape[1] == 2
