"""GLB as it is written: read again it is the same scene, and strangers can read it."""

import dataclasses
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from pipeline.exchange.convert import write_scene
from pipeline.exchange.gltf.read import read_gltf
from pipeline.exchange.gltf.write import encode_scene_glb
from storage.errors import TrilightError
from storage.records.lookup import texture_values
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS, SPECULAR
from storage.records.scene import Scene
from tests.for_each import for_each
from tests.scenes_by_hand import FLOOR, tiny_scene
from tests.textured_by_hand import colour_texture, corner_uv, number_texture, sky, textured_scene


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


def test_what_is_lost_is_said(tmp_path: Path) -> None:
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
