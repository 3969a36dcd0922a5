"""Blender shows our textures and our sky where we show them: minutes long, and only where it is."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from infra.bench.workloads.blender_environment import installed_python
from infra.bench.workloads.cycles import CyclesOptions, cycles_of_usd
from pipeline.exchange.usd.write import write_usd
from scene_templates.rotations import uniform_rotation
from storage.metrics import psnr_linear_db
from storage.records.environment import Environment
from storage.records.scene import Scene
from storage.records.texture import Texture
from tests.pipeline.exchange.usd.blender_kit import ours
from tests.sky_maps import as_sky, six_poles
from tests.textured_by_hand import number_texture, textured_scene

pytestmark = pytest.mark.slow("references")

RESOLUTION, SPP = 48, 256


def _scene() -> Scene:
    """A floor with four colours below a sky that is seen, turned by any rotation."""
    colours = np.array([[[180, 20, 20], [20, 180, 20]], [[20, 20, 180], [170, 170, 20]]], np.uint8)
    texture = Texture(texels=colours, is_srgb=True)  # wide texels: mostly what is between them
    turn = uniform_rotation(np.random.default_rng(4)).astype(np.float32)
    sky = as_sky(six_poles().radiance_rgb / 10, rotation=turn, is_seen=True)
    scene = textured_scene(0, texture, number_texture(), environment=sky)
    uv = 0.5 * scene.vertex_positions[scene.faces.ravel(), :2] + 0.5
    return dataclasses.replace(scene, uv=uv.astype(np.float32))


def _turned(sky: Environment | None) -> Environment:
    assert sky is not None
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], np.float32)
    return dataclasses.replace(sky, rotation=(sky.rotation @ quarter).astype(np.float32))


def test_textures_and_sky_are_where_we_show_them(tmp_path: Path, record_property: Any) -> None:
    """A mirrored texture and a sky a quarter off lose far more than the noise of both.

    So does a texture that is interpolated before it is decoded, as Cycles does by itself.
    """
    if installed_python() is None:
        pytest.skip("Blender is not installed: run `trilight bench cycles` once")
    scene = _scene()
    write_usd(tmp_path / "a.usdc", scene)
    request = CyclesOptions(resolution=RESOLUTION, spp=SPP, denoise=False, threads=2)
    (theirs,) = cycles_of_usd(tmp_path / "a.usdc", request, (0,)).pictures_rgb
    assert scene.uv is not None
    mirrored = scene.uv * np.array([-1, 1], np.float32)
    wrong = {
        "mirrored u": dataclasses.replace(scene, uv=mirrored),
        "a quarter turn of the sky": dataclasses.replace(
            scene, environment=_turned(scene.environment)
        ),
    }
    agreement = _db(scene, theirs)
    record_property("psnr_linear_db", round(agreement, 2))
    print(f"as it is: {agreement:.2f} dB")  # noqa: T201
    assert agreement > 36  # the aim of study S53
    for name, other in wrong.items():
        found = _db(other, theirs)
        print(f"{name}: {found:.2f} dB")  # noqa: T201
        assert found < 25, name


def _db(scene: Scene, theirs: NDArray[np.float32]) -> float:
    return psnr_linear_db(ours(scene, RESOLUTION, SPP), theirs)
