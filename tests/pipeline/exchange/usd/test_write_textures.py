"""Textures through USD: ours bit for bit, and where other programs find each corner."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pxr import Sdf, Usd, UsdGeom, UsdShade

from pipeline.exchange.usd.read import UsdScene, read_usd
from pipeline.exchange.usd.write import SUFFIXES, write_usd, write_usd_shard
from storage.errors import TrilightError
from storage.records.scene import Scene
from storage.records.scene_file import encode_scene, scene_digest
from storage.records.texture import MapSource, Texture
from tests.pipeline.exchange.exchange_kit import assert_usd_keeps_all
from tests.scenes_by_hand import FLOOR, LIGHT
from tests.textured_by_hand import number_texture, sky, textured_scene


def _read(path: Path) -> UsdScene:
    return read_usd(path, None, None, "CC0-1.0")


def _all_textured() -> Scene:
    """Every column textured, of 8 bits and of float32, and two materials that share textures."""
    rng = np.random.default_rng(5)
    diffuse = Texture(texels=rng.uniform(0, 0.5, (5, 3, 3)).astype(np.float32))
    specular = Texture(texels=rng.integers(0, 127, (2, 7, 3), np.uint8))
    number = Texture(texels=rng.integers(0, 256, (4, 4, 1), np.uint8), is_srgb=True,
                     source=MapSource(name='a "b" ü', licence="MIT", attribution="Ö"))  # fmt: skip
    base = textured_scene()
    index = np.array([[0, 1, 2], [-1, -1, -1], [-1, -1, 2]], np.int32)
    rows = np.concatenate([base.materials, base.materials[:1]])
    material_index = np.array([FLOOR, 2, LIGHT], np.uint16)
    return dataclasses.replace(
        base,
        materials=rows,
        material_index=material_index,
        textures=(diffuse, specular, number),
        material_textures=index,
    )


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_textures_come_back_bit_for_bit(tmp_path: Path, suffix: str) -> None:
    """Bytes as bytes and floats as floats, alone and below a sky."""
    scenes = (textured_scene(), textured_scene(environment=sky()), _all_textured())
    for number, scene in enumerate(scenes):
        folder = tmp_path / str(number)
        folder.mkdir()
        assert_usd_keeps_all(scene, folder, suffix)
        found = _read(folder / f"again{suffix}").scene
        assert scene_digest(found) == scene_digest(scene)
        files = {path.suffix for path in folder.iterdir()} - {suffix}
        assert files == (set() if suffix == ".usdz" else {".png", ".exr"})


def test_equal_scenes_have_equal_files(tmp_path: Path) -> None:
    for name in "ab":
        (tmp_path / name).mkdir()
        write_usd(tmp_path / name / "s.usdz", textured_scene(environment=sky()))
    assert (tmp_path / "a/s.usdz").read_bytes() == (tmp_path / "b/s.usdz").read_bytes()


def test_scenes_of_a_shard_keep_their_textures(tmp_path: Path) -> None:
    scenes = [textured_scene(seed) for seed in (0, 1, 0)]
    path = tmp_path / "many.usdc"
    write_usd_shard(path, ((f"k{row}", scene) for row, scene in enumerate(scenes)))
    assert len(list(tmp_path.glob("texture-*.png"))) == 2  # one content, one file
    for row, scene in enumerate(scenes):
        assert encode_scene(read_usd(path, f"k{row}", None, "").scene) == encode_scene(scene)


def test_one_colour_is_no_texture(tmp_path: Path) -> None:
    one = Texture(texels=np.full((3, 3, 3), 128, np.uint8), is_srgb=True)
    scene = textured_scene(0, one, number_texture())
    assert_usd_keeps_all(scene, tmp_path, ".usda")
    assert not list(tmp_path.glob("*.png"))


def test_other_programs_find_every_corner_where_we_have_it(tmp_path: Path) -> None:
    """By the words of USD alone: `st` of a corner, v up, the top row of a picture at v = 1."""
    texels = np.array([[[200, 0, 0], [0, 200, 0]], [[0, 0, 200], [90, 90, 0]]], np.uint8)
    scene = textured_scene(0, Texture(texels=texels, is_srgb=True), number_texture())
    path = tmp_path / "a.usda"
    write_usd(path, scene)
    stage = Usd.Stage.Open(str(path))
    shader = UsdShade.Shader(stage.GetPrimAtPath("/Scene/Materials/material_0/DiffuseTexture"))
    assert shader.GetInput("sourceColorSpace").Get() == "sRGB"
    assert [shader.GetInput(f"wrap{axis}").Get() for axis in "ST"] == ["repeat", "repeat"]
    picture = np.asarray(Image.open(tmp_path / shader.GetInput("file").Get().path))
    for u, v, column, row in ((0.25, 0.25, 0, 0), (0.75, 0.25, 1, 0), (0.25, 0.75, 0, 1)):
        assert (picture[int((1 - v) * 2), int(u * 2)] == texels[row, column]).all()
    primvar = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/Scene/Objects/floor")).GetPrimvar("st")
    assert primvar.GetInterpolation() == "faceVarying"
    assert np.array_equal(np.array(primvar.Get()), scene.uv[:6])  # type: ignore[index]


def test_renderers_of_materialx_get_the_textures_too(tmp_path: Path) -> None:
    """A textured material has no constant OpenPBR that they would prefer; others keep it."""
    write_usd(tmp_path / "a.usda", textured_scene())
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    for row, expected in (
        (FLOOR, "UsdPreviewSurface"),
        (LIGHT, "ND_open_pbr_surface_surfaceshader"),
    ):
        material = UsdShade.Material(stage.GetPrimAtPath(f"/Scene/Materials/material_{row}"))
        assert material.ComputeSurfaceSource("mtlx")[0].GetShaderId() == expected


def test_a_texture_that_was_changed_is_read_as_it_is_now(tmp_path: Path) -> None:
    path = tmp_path / "a.usda"
    write_usd(path, textured_scene())
    (file,) = tmp_path.glob("texture-*.png")
    Image.fromarray(np.full((4, 6, 3), 255, np.uint8)).save(file)
    found = _read(path)
    assert not found.exact and any("changed since" in text for text in found.lost)


def test_an_edited_connection_is_seen(tmp_path: Path) -> None:
    path = tmp_path / "a.usda"
    write_usd(path, textured_scene())
    layer = Sdf.Layer.FindOrOpen(str(path))
    shader = layer.GetPrimAtPath("/Scene/Materials/material_0/Preview")
    shader.attributes["inputs:diffuseColor"].connectionPathList.ClearEdits()
    layer.Export(str(tmp_path / "b.usda"))
    assert not _read(tmp_path / "b.usda").exact


def test_a_texture_too_large_for_usd_is_refused(tmp_path: Path) -> None:
    long = np.zeros((1, 8193, 3), np.uint8)
    long[0, 0] = 1
    scene = textured_scene(0, Texture(texels=long), number_texture())
    with pytest.raises(TrilightError, match="texture: 8193 x 1 texels; expected at most 8192"):
        write_usd(tmp_path / "a.usda", scene)
