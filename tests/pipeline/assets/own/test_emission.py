"""What surfaces emit: the mean of the map over each triangle, alike of every form of file."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdShade

from pipeline.assets.mesh import TriangleMesh
from pipeline.assets.settings import AssetSettings
from storage.conventions import linear_from_srgb8
from storage.records.asset import decode_asset, encode_asset
from tests.pipeline.assets.meshes_by_hand import geometry, prepare, sphere, write_glb
from tests.pipeline.assets.own.textured_kit import (
    KEEP,
    OWN,
    lost,
    picture_bytes,
    textured_obj,
    textured_tree,
)
from tests.pipeline.assets.own.usd_kit import SHADER, TEXTURE, textured_usd

GLOW = AssetSettings(own_materials=dataclasses.replace(OWN, emission=True))
UPPER, LOWER = 200, 100
HALVES = np.repeat(np.repeat(np.array([[UPPER], [LOWER]], np.uint8), 32, 0), 64, 1)
"""The upper half brighter than the lower one."""
PICTURE = picture_bytes(np.repeat(HALVES[..., None], 3, axis=2) * np.array([1, 1, 0], np.uint8))


def glb(path: Path, strength: float = 1.0) -> Path:
    tree, buffer = textured_tree(PICTURE)
    tree["materials"][0] |= {"emissiveFactor": [1, 0.5, 1], "emissiveTexture": {"index": 0}}
    tree["materials"][0]["extensions"] = {
        "KHR_materials_emissive_strength": {"emissiveStrength": strength}
    }
    return write_glb(path, tree, buffer)


def usd(path: Path) -> Path:
    def glowing(stage: Usd.Stage) -> None:
        shader = UsdShade.Shader(stage.GetPrimAtPath(SHADER))
        node = UsdShade.Shader(stage.GetPrimAtPath(TEXTURE))
        node.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(1, 0.5, 1, 1))
        shader.CreateInput("emissiveColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(
            node.ConnectableAPI(), "rgb"
        )

    return textured_usd(path, PICTURE, glowing)


def obj(path: Path) -> Path:
    return textured_obj(path, PICTURE, "Kd 1 1 1\nKe 1 0.5 1\nmap_Ke its picture.png\n")


FILES: dict[str, Callable[[Path], Path]] = {
    "glb": lambda folder: glb(folder / "a.glb"),
    "usd": lambda folder: usd(folder / "a.usda"),
    "obj": lambda folder: obj(folder / "o" / "a.obj"),
}


def emission(path: Path, settings: AssetSettings = GLOW) -> tuple[NDArray, TriangleMesh]:
    asset = prepare(path, settings)
    assert asset.materials is not None and "emission" not in asset.materials.lost
    level = asset.levels[0]
    assert level.skin is not None and level.skin.emission is not None
    mesh = TriangleMesh(positions=level.positions.astype(float), faces=level.faces.astype(int))
    return level.skin.emission, mesh


@pytest.mark.parametrize("kind", FILES)
def test_a_triangle_emits_the_mean_of_the_map_over_it(tmp_path: Path, kind: str) -> None:
    """Of a square cut along its diagonal: three quarters of one half, and a quarter of the other.

    To the 36 points of a triangle: one of them is 2.8 % of it.
    """
    found, mesh = emission(FILES[kind](tmp_path))
    high, low = linear_from_srgb8()[[UPPER, LOWER]]
    above = mesh.corners.mean(axis=1)[:, 2] > 0
    wanted = np.where(above, 0.75 * high + 0.25 * low, 0.25 * high + 0.75 * low)
    assert np.abs(found - wanted[:, None] * [1, 0.5, 0]).max() < 0.03 * (high - low) + 1e-3


def test_strength_scales_it(tmp_path: Path) -> None:
    once, _ = emission(glb(tmp_path / "a.glb"))
    often, _ = emission(glb(tmp_path / "b.glb", strength=12.5))
    assert np.allclose(often, 12.5 * once)


@pytest.mark.parametrize("strength", [float("nan"), float("inf"), 1e300])
def test_strength_that_is_no_light(tmp_path: Path, strength: float) -> None:
    assert lost(glb(tmp_path / "a.glb", strength), GLOW) == "materials_unreadable"


def test_what_is_far_darker_than_the_brightest_triangle_emits_nothing(tmp_path: Path) -> None:
    ball = sphere(rings=6, columns=9)
    uv = np.where(ball.positions[:, 2:] > 0.2, [[0.5, 0.75]], [[0.5, 0.25]])
    tree, buffer = textured_tree(
        picture_bytes(np.repeat(np.array([[[255] * 3], [[20] * 3]], np.uint8), 2, 1)), uv, ball
    )
    tree["materials"][0] |= {"emissiveFactor": [1, 1, 1], "emissiveTexture": {"index": 0}}
    found, mesh = emission(write_glb(tmp_path / "a.glb", tree, buffer))
    height = mesh.corners[..., 2]
    assert not found[height.max(axis=1) < 0].any()
    assert found[height.min(axis=1) > 0.3].all()


@pytest.mark.parametrize("kind", FILES)
def test_nobody_pays_who_does_not_ask(tmp_path: Path, kind: str) -> None:
    """And what is lost is named; a missing picture of it costs no material."""
    path = FILES[kind](tmp_path)
    plain, glows = prepare(path, KEEP), prepare(path, GLOW)
    assert plain.materials is not None and "emission" in plain.materials.lost
    assert b"emission_" not in encode_asset(plain) and geometry(plain) == geometry(glows)
    ours, theirs = plain.levels[0].skin, glows.levels[0].skin
    assert ours is not None and theirs is not None and ours.packed == theirs.packed
    again = decode_asset(encode_asset(glows)).levels[0].skin
    assert again is not None and again.emission is not None
    assert np.array_equal(again.emission, theirs.emission)  # type: ignore[arg-type]


def test_a_missing_emissive_picture(tmp_path: Path) -> None:
    path = obj(tmp_path / "o" / "a.obj")
    (path.parent / "its picture.png").unlink()
    assert prepare(path, KEEP).levels[0].skin is not None
    found = prepare(path, GLOW).materials
    assert found is not None and found.reason == "texture_missing"
