"""Environments through USD: ours bit for bit, and foreign domes by the axes that USD states."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdLux

from pipeline.exchange.usd.read import UsdScene, read_usd
from pipeline.exchange.usd.write import write_usd, write_usd_shard
from scene_templates.rotations import uniform_rotation
from storage.records.environment import Environment
from storage.records.lookup import environment_values
from storage.records.scene import Scene
from tests.pipeline.exchange.exchange_kit import assert_usd_keeps_all
from tests.scenes_by_hand import tiny_scene
from tests.sky_maps import COLOURS, POLES, one_sun, six_poles, smooth


def _read(path: Path) -> UsdScene:
    return read_usd(path, None, None, "CC0-1.0")


def _sky(scene: Scene) -> Environment:
    assert scene.environment is not None
    return scene.environment


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
def test_an_environment_comes_back_bit_for_bit(tmp_path: Path, suffix: str) -> None:
    """A sun above what half floats hold, turned by any rotation, seen and not."""
    turn = uniform_rotation(np.random.default_rng(1)).astype(np.float32)
    for number, sky in enumerate((one_sun(1e6, rotation=turn), six_poles(is_seen=True))):
        folder = tmp_path / str(number)
        folder.mkdir()
        assert_usd_keeps_all(tiny_scene(environment=sky), folder, suffix)


def test_scenes_of_a_shard_keep_their_skies(tmp_path: Path) -> None:
    scenes = [tiny_scene(environment=sky) for sky in (smooth(), None, smooth(is_seen=True))]
    path = tmp_path / "many.usdc"
    write_usd_shard(path, ((f"k{row}", scene) for row, scene in enumerate(scenes)))
    assert len(list(tmp_path.glob("sky-*.exr"))) == 1  # one content
    for row, scene in enumerate(scenes):
        found = read_usd(path, f"k{row}", None, "").scene
        assert (found.environment is None) == (scene.environment is None)
        if scene.environment is not None:
            assert _sky(found).sha256 == scene.environment.sha256
            assert _sky(found).is_seen == scene.environment.is_seen


def test_other_programs_find_each_pole_where_we_have_it(tmp_path: Path) -> None:
    """By the convention of USD alone: the middle is +Z of the dome, a quarter +X, the top +Y."""
    turn = uniform_rotation(np.random.default_rng(2)).astype(np.float32)
    sky = six_poles(rotation=turn)
    path = tmp_path / "a.usda"
    write_usd(path, tiny_scene(environment=sky))
    stage = Usd.Stage.Open(str(path))
    dome = UsdLux.DomeLight(stage.GetPrimAtPath("/Scene/Environment"))
    matrix = dome.ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    places = {
        "+Z": (0.5, 0.5),
        "+X": (0.25, 0.5),
        "-X": (0.75, 0.5),
        "+Y": (0.5, 1),
        "-Y": (0.5, 0),
    }
    radiance = sky.radiance_rgb
    for name, (u, v) in places.items():
        world = np.array(matrix.TransformDir(Gf.Vec3d(*map(float, POLES[name]))))
        row = min(int((1 - v) * len(radiance)), len(radiance) - 1)
        column = int(u * 2 * len(radiance))
        assert environment_values(sky, world) == pytest.approx(radiance[row, column])


def _foreign(path: Path, edit: NDArray[np.float64] | None = None) -> Usd.Stage:
    write_usd(path, tiny_scene(environment=six_poles()))
    stage = Usd.Stage.Open(str(path))
    if edit is not None:
        stage.GetPrimAtPath("/Scene/Environment").GetAttribute("xformOp:transform").Set(
            Gf.Matrix4d(edit.T.tolist())
        )
    return stage


@pytest.mark.parametrize("up", ["Y", "Z"])
def test_a_foreign_dome_stands_by_the_axes_of_usd(tmp_path: Path, up: str) -> None:
    """Unturned: the top of the picture is +Y of the stage, whichever axis is up there."""
    path = tmp_path / "a.usda"
    stage = _foreign(path, np.eye(4))
    stage.SetMetadata("upAxis", up)
    light = UsdLux.DomeLight(stage.GetPrimAtPath("/Scene/Environment"))
    light.GetIntensityAttr().Set(2.0)
    light.CreateExposureAttr(1.0)
    stage.Save()
    found = _read(path)
    assert not found.exact
    of_picture = {"top": "+Z", "middle": "+X", "quarter": "+Y"}  # its colours, by our own axes
    world = {"Z": {"top": (0, 1, 0), "middle": (0, 0, 1), "quarter": (1, 0, 0)},
             "Y": {"top": (0, 0, 1), "middle": (0, -1, 0), "quarter": (1, 0, 0)}}[up]  # fmt: skip
    for part, pole in of_picture.items():
        value = environment_values(_sky(found.scene), world[part])
        assert value == pytest.approx(4 * np.array(COLOURS[pole]), rel=1e-5), part


def test_a_dome_without_a_file_is_even_and_may_be_the_only_light(tmp_path: Path) -> None:
    path = tmp_path / "a.usda"
    stage = _foreign(path)
    light = UsdLux.DomeLight(stage.GetPrimAtPath("/Scene/Environment"))
    light.GetTextureFileAttr().Clear()
    light.CreateColorAttr(Gf.Vec3f(1.0, 0.5, 0.25))
    stage.Save()
    np.testing.assert_allclose(_sky(_read(path).scene).radiance_rgb, [[[1, 0.5, 0.25]] * 2])


@pytest.mark.parametrize(
    ("asset", "said"),
    [("./missing.exr", "is missing"), ("./text.exr", "is not read"), ("./wide.exr", "shape")],
)
def test_a_map_that_cannot_be_read_is_said(tmp_path: Path, asset: str, said: str) -> None:
    from storage.records.exr import encode_channels

    path = tmp_path / "a.usda"
    stage = _foreign(path)
    (tmp_path / "text.exr").write_bytes(b"no picture")
    wide = encode_channels({"RGB": np.ones((4, 4, 3), np.float32)})
    (tmp_path / "wide.exr").write_bytes(wide)
    light = UsdLux.DomeLight(stage.GetPrimAtPath("/Scene/Environment"))
    light.GetTextureFileAttr().Set(Sdf.AssetPath(asset))
    stage.Save()
    found = _read(path)
    assert found.scene.environment is None
    assert any(said in text for text in found.lost)


def test_a_map_that_was_changed_is_read_as_it_is_now(tmp_path: Path) -> None:
    """The scene is no longer the one that was written, and the digest says so."""
    from storage.records.exr import encode_channels

    path = tmp_path / "a.usda"
    _foreign(path)
    (file,) = tmp_path.glob("sky-*.exr")
    file.write_bytes(encode_channels({"RGB": np.full((2, 4, 3), 7, np.float32)}))
    found = _read(path)
    assert not found.exact
    assert (_sky(found.scene).radiance_rgb == 7).all()


def test_a_scene_that_only_a_sky_lights_keeps_it(tmp_path: Path) -> None:
    scene = tiny_scene(environment=smooth())
    dark = dataclasses.replace(scene, environment=None)
    assert scene.num_triangles == dark.num_triangles
    path = tmp_path / "a.usda"
    stage = _foreign(path)
    for prim in stage.Traverse():
        if prim.GetTypeName() == "Mesh" and prim.GetAttribute("trilight:kind").Get() == "emitter":
            prim.SetActive(False)
    stage.Save()
    found = _read(path).scene
    assert not found.triangle_emits.any()
    assert _sky(found).sha256 == six_poles().sha256
