"""Textures as RenderFormer's cells and back: the layout, area means, and what look-ups find."""

import dataclasses
from pathlib import Path

import h5py
import numpy as np
import pytest

from pipeline.exchange.convert import write_scene
from pipeline.exchange.renderformer_cells import CELLS, cells_of, filled_cells
from pipeline.exchange.renderformer_h5 import read_renderformer_h5, write_renderformer_h5
from storage.records.lookup import textured_rows
from storage.records.material import EMISSION
from storage.records.scene import Scene
from storage.records.texture import Texture
from tests.pipeline.exchange.exchange_kit import row_at
from tests.textured_by_hand import number_texture, textured_scene


def _smooth_scene() -> Scene:
    """The floor with a texture that changes slowly, looked up from (-0.5, -0.5) to (0.5, 0.5)."""
    at = (np.arange(64) + 0.5) / 64
    wave = 0.4 + 0.3 * np.cos(2 * np.pi * at)
    colour = np.stack(np.broadcast_arrays(wave[None], wave[:, None], np.float64(0.2)), axis=-1)
    rough = Texture(texels=(0.5 + 0.4 * np.sin(2 * np.pi * at))[:, None, None].astype(np.float32))
    scene = textured_scene(0, Texture(texels=colour.astype(np.float32)), rough)
    uv = 0.5 * scene.vertex_positions[scene.faces.ravel(), :2]
    return dataclasses.replace(scene, uv=uv.astype(np.float32))


def test_a_ramp_has_the_means_of_its_cells(tmp_path: Path) -> None:
    """u is the weight of the first vertex and v that of the second: cell (x, y) is their middle."""
    ramp = (np.arange(256, dtype=np.float32) + 0.5) / 256 / 2
    along = np.broadcast_to(ramp[None, :, None], (256, 256, 3)).astype(np.float32)
    rough = np.broadcast_to(ramp[:, None, None], (256, 256, 1)).astype(np.float32)
    scene = textured_scene(0, Texture(texels=along), Texture(texels=np.ascontiguousarray(rough)))
    corners = np.array([[0.98, 0.01], [0.01, 0.98], [0.01, 0.01]], np.float32)  # away from the seam
    scene = dataclasses.replace(scene, uv=np.tile(corners, (3, 1)))
    (_, diffuse), (_, roughness) = cells_of(scene, 0)
    x, y = np.meshgrid(np.arange(CELLS), np.arange(CELLS))
    whole = filled_cells() & (x + y < CELLS - 1)  # others lie partly beyond the triangle
    for found, place in ((diffuse[0], x), (roughness[0], y)):
        middle = (0.01 + 0.97 * (place + 0.5) / CELLS) / 2
        assert found[whole] == pytest.approx(middle[whole], abs=1e-4)
    assert (diffuse[:, ~filled_cells()] == 0).all()


def test_a_fine_checker_is_grey_in_every_cell() -> None:
    """A mean over the area: samples at the middle would be black or white."""
    checker = (np.indices((64, 64)).sum(axis=0) % 2).astype(np.float32)
    texels = np.repeat(0.8 * checker[..., None], 3, axis=-1)
    scene = textured_scene(0, Texture(texels=texels), number_texture())
    corners = np.array([[4, 0], [0, 4], [0, 0]], np.float32)  # 8 texels a cell
    scene = dataclasses.replace(scene, uv=np.tile(corners, (3, 1)))
    x, y = np.meshgrid(np.arange(CELLS), np.arange(CELLS))
    assert cells_of(scene, 0)[0][1][0][x + y < CELLS - 1] == pytest.approx(0.4, abs=0.01)


def test_a_smooth_texture_comes_back_as_an_atlas(tmp_path: Path) -> None:
    """Half a cell at the greatest slope, where look-ups are clamped, and 8 bits: 0.03 + 0.005."""
    scene = _smooth_scene()
    notes = write_scene(tmp_path / "a.h5", scene)
    assert any("2 textured triangles than the means of 32 x 32" in note for note in notes)
    found = read_renderformer_h5(tmp_path / "a.h5")
    assert not any("mean was taken" in text for text in found.lost)
    back = found.scene
    rng = np.random.default_rng(3)
    for x, y in rng.uniform(-0.99, 0.99, (60, 2)):
        assert row_at(back, x, y)[:7] == pytest.approx(row_at(scene, x, y)[:7], abs=0.035)
    lit = back.materials[back.material_index][:, EMISSION]
    assert np.array_equal(lit, scene.materials[scene.material_index][:, EMISSION])


def test_corners_have_the_colours_of_their_cells(tmp_path: Path) -> None:
    """No look-up meets the square of another triangle, not even at its own edges."""
    path = tmp_path / "a.h5"
    write_renderformer_h5(path, textured_scene())
    with h5py.File(path, "r+") as file:
        texture = file["texture"]
        for triangle, level in ((0, 0.25), (1, 0.75)):
            cells = np.where(filled_cells(), np.float32(level), np.float32(0))
            cells[0, 0] = level - 0.125  # so that it varies
            texture[triangle, :3] = cells
            texture[triangle, 3:6] = 0
    scene = read_renderformer_h5(path).scene
    assert scene.uv is not None
    uv = scene.uv.reshape(-1, 3, 2).astype(np.float64)
    for triangle, level in ((0, 0.25), (1, 0.75)):
        for weights in ([1, 0, 0], [0, 1, 0], [0.5, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0.5]):
            at = np.array(weights) @ uv[triangle]
            row = textured_rows(scene, scene.material_index[[triangle]], at[None])[0]
            assert row[:3] == pytest.approx([level] * 3, abs=0.005)  # 8 bits


def test_plain_scenes_are_written_as_before(tmp_path: Path) -> None:
    scene = textured_scene()
    plain = dataclasses.replace(scene, uv=None, textures=(), material_textures=None)
    write_renderformer_h5(tmp_path / "a.h5", plain)
    assert not read_renderformer_h5(tmp_path / "a.h5").scene.textures
