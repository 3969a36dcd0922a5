"""What a browser is given of a scene, read back as the browser reads it."""

import io
import json
import struct
from typing import Any

import numpy as np
import pytest
from PIL import Image

from infra.viewer import scene_bytes as module
from infra.viewer.scene_bytes import scene_bytes, sky_bytes, texture_png
from storage.errors import TrilightError
from storage.records.environment import Environment
from storage.records.scene import Scene
from tests.scenes_by_hand import tiny_scene
from tests.textured_by_hand import colour_texture, number_texture, textured_scene


def parts(scene: Scene) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray]:
    data = scene_bytes(scene)
    (length,) = struct.unpack("<I", data[:4])
    head = json.loads(data[4 : 4 + length])
    assert length % 4 == 0
    numbers, corners = np.frombuffer(data[4 + length :], "<f4"), head["corners"]
    positions, normals, uv = np.split(numbers, [3 * corners, 6 * corners])
    return head, positions.reshape(-1, 3), normals.reshape(-1, 3), uv.reshape(-1, 2)


def test_every_triangle_stands_in_the_group_of_its_object_and_material() -> None:
    scene = textured_scene()
    head, positions, normals, uv = parts(scene)
    assert len(positions) == len(normals) == len(uv) == 3 * scene.num_triangles
    seen = []
    for group in head["groups"]:
        rows = slice(group["first"], group["first"] + group["count"])
        for corners, looked_up in zip(
            positions[rows].reshape(-1, 3, 3), uv[rows].reshape(-1, 3, 2), strict=True
        ):
            same = [
                row
                for row in range(scene.num_triangles)
                if np.array_equal(scene.vertex_positions[scene.faces[row]], corners)
            ]
            (row,) = same
            assert scene.object_index[row] == group["object"]
            assert scene.material_index[row] == group["material"]
            assert scene.uv is not None
            np.testing.assert_array_equal(scene.uv.reshape(-1, 3, 2)[row], looked_up)
            seen.append(row)
    assert sorted(seen) == list(range(scene.num_triangles))
    assert head["materials"][0]["maps"] == {"diffuse": 0, "roughness": 1}
    assert head["cameras"][1]["c2w"] == pytest.approx(scene.c2w[1].reshape(-1).tolist())
    assert [lamp["object"] for lamp in head["lamps"]] == [1]


def test_a_scene_without_textures_has_no_coordinates() -> None:
    head, _, _, uv = parts(tiny_scene())
    assert not head["uv"] and not len(uv)


def test_textures_come_with_their_bottom_row_last() -> None:
    for texture in (colour_texture(3), number_texture()):
        pixels = np.asarray(Image.open(io.BytesIO(texture_png(texture))))
        assert pixels.shape == (*texture.texels.shape[:2], 3)
        if texture.is_srgb:
            np.testing.assert_array_equal(pixels[::-1], texture.texels)


@pytest.mark.parametrize("turned", [False, True])
def test_a_sky_shines_from_where_it_does(turned: bool) -> None:
    """A map that is red towards +X, green towards +Y, blue towards +Z, found as three.js does."""
    rows = 32
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(64) + 0.5) / 64, indexing="ij")
    angle = (0.5 - u) * 2 * np.pi
    flat = np.sin(v * np.pi)
    axes = np.stack([flat * np.cos(angle), flat * np.sin(angle), np.cos(v * np.pi)], axis=-1)
    radiance = np.maximum(axes, 0).astype(np.float32)
    rotation = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]] if turned else np.eye(3), np.float32)
    scene = textured_scene(environment=Environment(radiance_rgb=radiance, rotation=rotation))
    width, height = struct.unpack("<II", sky_bytes(scene)[:8])
    texels = np.frombuffer(sky_bytes(scene)[8:], "<f4").reshape(height, width, 4)
    for axis in range(3):
        for x, y, z in (np.eye(3)[axis], -np.eye(3)[axis]):
            at_u, at_v = np.arctan2(z, x) / (2 * np.pi) + 0.5, np.arcsin(y) / np.pi + 0.5
            row, column = min(int(at_v * height), height - 1), int(at_u * width) % width
            wanted = np.maximum(rotation.T @ np.array([x, y, z]), 0)
            np.testing.assert_allclose(texels[row, column, :3], wanted, atol=0.11)


def test_what_a_browser_cannot_draw_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_TRIANGLES", 2)
    with pytest.raises(TrilightError, match="3 triangles; expected at most 2"):
        scene_bytes(tiny_scene())
    monkeypatch.setattr(module, "MOST_TRIANGLES", 3)
    monkeypatch.setattr(module, "MOST_GROUPS", 1)
    with pytest.raises(TrilightError, match="2 parts"):
        scene_bytes(tiny_scene())
