"""An object's colours and light from its file to its asset: orientation, exactness, workflows."""

import dataclasses
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pxr import Gf, Usd, UsdGeom

from pipeline.assets.cleaning.clean import clean, normalize
from pipeline.assets.cleaning.orient import orient_outward
from pipeline.assets.quality.measure import Surface, level_mesh
from pipeline.assets.settings import AssetSettings, OwnMaterialSettings
from pipeline.assets.source_materials.skin import add_skin, read_source_surface
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.source_file import load_mesh, read_source
from storage.conventions import linear_from_srgb8
from storage.errors import Rejected
from storage.records.asset import LevelSkin, decode_asset, encode_asset
from storage.settings.described import settings_record
from tests.command_line import trilight
from tests.for_each import for_each
from tests.pipeline.assets import meshes_by_hand as meshes
from tests.pipeline.assets.source_materials import textured_kit as kit

PICTURE = kit.picture_bytes(kit.CORNERS)


def _transformed_glb(path: Path) -> Path:
    """A quarter turn about the lower left and a shift back: by the formula of the extension."""
    tree, buffer = kit.textured_tree(PICTURE)
    slot = tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    turn = {"rotation": np.pi / 2, "offset": [0.0, 1.0], "scale": [1, 1]}
    slot["extensions"] = {"KHR_texture_transform": turn}
    # (u, w), w down, reads shift + [[cos, sin], [-sin, cos]] (u, w) = (w, 1 - u)
    return meshes.write_glb(path, tree, buffer)


def _place_quad(stage: Usd.Stage) -> None:
    """One polygon with coordinates of its corners, a quarter turn above it: +y, x to -z."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(kit.MESH))
    mesh.GetFaceVertexCountsAttr().Set([4])
    mesh.GetFaceVertexIndicesAttr().Set([0, 1, 2, 3])
    kit.coordinates(mesh, kit.UV_UP, "faceVarying")
    UsdGeom.Xformable(stage.GetPrimAtPath("/W")).AddRotateYOp().Set(90)


TURNED: dict[str, Callable[[Path], Path]] = {
    "glb transform": lambda folder: _transformed_glb(folder / "a.glb"),
    # counter-clockwise and a shift back: (s, t) reads (1 - t, s)
    "usd transform": lambda folder: kit.textured_usd(
        folder / "a.usda", PICTURE, lambda it: kit.transform_coordinates(it, 90.0, (1, 1), (1, 0))
    ),
    "usd quad": lambda folder: kit.textured_usd(folder / "a.usda", PICTURE, _place_quad),
}


def _in_centimetres(folder: Path, suffix: str) -> Path:
    return kit.textured_usd(folder / f"a.{suffix}", PICTURE, y_up=True, unit=0.01)


FILES: dict[str, Callable[[Path], Path]] = {
    "glb": lambda folder: kit.textured_glb(folder / "a.glb", PICTURE),
    "along": lambda folder: kit.textured_glb(folder / "a.glb", PICTURE, np.add(kit.UV_UP, (3, -2))),
    "back": lambda folder: kit.textured_glb(folder / "a.glb", PICTURE, np.add(kit.UV_UP, (-7, 1))),
    "gltf": lambda folder: kit.textured_gltf(folder / "a.gltf", PICTURE),
    "obj": lambda folder: kit.textured_obj(folder / "o" / "a.obj", PICTURE),
    **{form: partial(_in_centimetres, suffix=form) for form in ("usda", "usdc", "usd", "usdz")},
    **TURNED,
}


@for_each("kind", FILES)
def test_a_quad_keeps_its_corner_colours(tmp_path: Path, kind: str) -> None:
    """A mirrored u or v, or a quarter turn, would swap them; beyond 1 the picture repeats."""
    asset = meshes.prepare(FILES[kind](tmp_path), kit.KEEP)
    kit.assert_corners(asset, lambda right, up: (up, -right) if kind in TURNED else (right, up))


def _plain_skin(path: Path, extensions: dict[str, Any] | None = None, **metal: Any) -> LevelSkin:
    """Return the skin of a ball of one material without a picture."""
    tree, buffer = meshes.gltf_tree(meshes.sphere(rings=6, columns=9))
    tree["meshes"][0]["primitives"][0]["material"] = 0
    tree["materials"] = [{"pbrMetallicRoughness": metal, "extensions": extensions or {}}]
    skin = meshes.prepare(meshes.write_glb(path, tree, buffer), kit.KEEP).levels[0].skin
    assert skin is not None
    return skin


def test_constants_are_exact_and_metals_have_no_diffuse_part(tmp_path: Path) -> None:
    base, path = np.array([0.3, 0.62, 0.011]), tmp_path / "a.glb"
    factor: dict[str, Any] = {"baseColorFactor": [*base, 1.0]}
    skin = _plain_skin(path, **factor, metallicFactor=0.0, roughnessFactor=0.37)
    diffuse, specular, roughness = skin.textures
    assert [texture.texels.shape[:2] for texture in skin.textures] == [(1, 1)] * 3
    assert np.array_equal(diffuse.texels[0, 0], (base * (1 - kit.F)).astype(np.float32))
    assert np.array_equal(specular.texels[0, 0], np.full(3, kit.F, np.float32))
    assert roughness.texels[0, 0, 0] == np.float32(0.37)
    diffuse, specular, _ = _plain_skin(path, **factor, metallicFactor=1.0).textures
    assert not diffuse.texels.any()
    assert np.allclose(specular.texels[0, 0], base + (1 - base) / 21, atol=1e-6)
    words = {"specularFactor": 0.5, "specularColorFactor": [2.0, 1.0, 0.0]}
    _, specular, _ = _plain_skin(path, {"KHR_materials_specular": words}, metallicFactor=0).textures
    f0 = np.array([0.04, 0.02, 0.0])
    # the extension scales what is reflected at grazing angles too: F90 is its factor
    assert np.allclose(specular.texels[0, 0], f0 + (0.5 - f0) / 21, atol=1e-6)


def test_metal_is_blue_and_roughness_green(tmp_path: Path) -> None:
    """And both are linear, whatever the picture is flagged as: the slot decides."""
    picture = kit.picture_bytes(np.array([[[9, 51, 0], [9, 204, 255]]], np.uint8))
    tree, buffer = kit.textured_tree(picture)
    metal = tree["materials"][0]["pbrMetallicRoughness"]
    metal |= {"metallicRoughnessTexture": metal.pop("baseColorTexture"), "metallicFactor": 1}
    asset = meshes.prepare(meshes.write_glb(tmp_path / "a.glb", tree, buffer), kit.KEEP)
    for right, code, diffuse in ((-0.25, 51, 1 - kit.F), (0.25, 204, 0.0)):
        assert abs(kit.seen_at(asset, right, 0, 2)[0] - code / 255) < kit.STORED
        assert np.abs(kit.seen_at(asset, right, 0) - diffuse).max() < kit.STORED


def test_an_undecimated_level_shows_the_source_within_a_texel(tmp_path: Path) -> None:
    """A ramp along u on a ball: colours change by its slope times a texel, and by 8 bits."""
    ball = meshes.sphere(rings=9, columns=16)
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=2)
    uv = ball.positions[:, [0, 2]] - ball.positions[:, [0, 2]].min(axis=0)
    uv /= uv.max(axis=0)
    picture = kit.picture_bytes(np.repeat(ramp, 2, axis=0))
    path = kit.textured_glb(tmp_path / "a.glb", picture, uv, ball)
    own = dataclasses.replace(kit.OWN, texels=128)
    level = meshes.prepare(path, dataclasses.replace(kit.KEEP, own_materials=own)).levels[0]
    assert level.record.method == "source" and level.skin is not None
    quality = level.skin.quality
    slope = 2.4  # of the sRGB curve at white, by which codes become light
    assert quality.colour_error < slope / quality.texels_per_length
    assert quality.missed_cells == 0 and quality.torn_seams == 0
    coarse = meshes.prepare(path, dataclasses.replace(kit.KEEP, budgets=(60,))).levels[0].skin
    assert coarse is not None and coarse.quality.colour_error > 2 * quality.colour_error


def test_a_texture_may_be_as_large_as_is_said_and_no_larger(tmp_path: Path) -> None:
    path = kit.textured_glb(tmp_path / "a.glb", PICTURE)

    def side(size: int) -> int:
        own = dataclasses.replace(kit.OWN, size=size)
        skin = meshes.prepare(path, dataclasses.replace(kit.KEEP, own_materials=own)).levels[0].skin
        assert skin is not None
        return max(skin.textures[0].texels.shape[:2])

    wanted = side(kit.OWN.size)
    assert side(wanted) == wanted < kit.OWN.size
    assert side(wanted - 1) < wanted


def test_materials_change_no_triangle_survive_their_file_and_are_nothing_where_they_are_off(
    tmp_path: Path,
) -> None:
    path = kit.textured_glb(tmp_path / "a.glb", PICTURE)
    own, plain = meshes.prepare(path, kit.KEEP), meshes.prepare(path)
    assert meshes.geometry(own) == meshes.geometry(plain)
    assert own.geometry_sha256 == plain.geometry_sha256
    bare = tuple(dataclasses.replace(level, skin=None) for level in own.levels)
    stripped = dataclasses.replace(own, materials=None, levels=bare)
    assert encode_asset(stripped) == encode_asset(plain)
    assert b"skin" not in encode_asset(plain) and b"materials" not in encode_asset(plain)
    again = decode_asset(encode_asset(own))
    assert again.materials == own.materials
    ours, theirs = own.levels[0].skin, again.levels[0].skin
    assert ours is not None and theirs is not None and ours.quality == theirs.quality
    assert np.array_equal(ours.uv, theirs.uv)
    assert [t.sha256 for t in ours.textures] == [t.sha256 for t in theirs.textures]


def test_two_materials_meet_in_one_atlas_and_none_says_so(tmp_path: Path) -> None:
    """And the faces of a part without any get what glTF says of them."""
    path = tmp_path / "o" / "a.obj"
    kit.textured_obj(path, b"", mtl="Kd 1 0 0\nillum 1\nnewmtl other\nKd 0 0 1\nillum 1\n")
    path.write_text(path.read_text().replace("f 1/1 3/3", "usemtl other\nf 1/1 3/3"))
    asset = meshes.prepare(path, kit.KEEP)
    assert np.allclose(kit.seen_at(asset, 0.25, -0.25), [1, 0, 0], atol=kit.STORED)
    assert np.allclose(kit.seen_at(asset, -0.25, 0.25), [0, 0, 1], atol=kit.STORED)
    assert np.allclose(kit.seen_at(asset, -0.25, 0.25, 1), 0)
    asset = meshes.prepare(meshes.write_obj(tmp_path / "a.obj", kit.SQUARE), kit.KEEP)
    assert asset.materials is not None and asset.materials.reason == "no_materials"


def test_what_nothing_here_can_show_is_named(tmp_path: Path) -> None:
    tree, buffer = kit.textured_tree(PICTURE)
    tree["materials"][0] |= {"emissiveFactor": [1, 1, 1], "alphaMode": "BLEND"}
    tree["materials"][0]["extensions"] = {"KHR_materials_clearcoat": {}}
    asset = meshes.prepare(meshes.write_glb(tmp_path / "a.glb", tree, buffer), kit.KEEP)
    assert asset.materials is not None
    assert asset.materials.lost == ("clearcoat", "emission", "transparency")


def test_transmission_is_made_opaque_and_said_or_refused(tmp_path: Path) -> None:
    tree, buffer = kit.textured_tree(PICTURE)
    tree["materials"][0]["normalTexture"] = {"index": 0}
    tree["materials"][0]["extensions"] = {"KHR_materials_transmission": {"transmissionFactor": 1}}
    (tmp_path / "in").mkdir()
    path = meshes.write_glb(tmp_path / "in/a.glb", tree, buffer)
    kit.assert_corners(meshes.prepare(path, kit.KEEP))  # opaque, in its own colours
    for if_lost in ("drawn", "reject"):
        own = dataclasses.replace(kit.OWN, transmission="reject", if_lost=if_lost)
        refuse = dataclasses.replace(kit.KEEP, own_materials=own)
        with pytest.raises(Rejected, match="its materials have transmission; expected") as refusal:
            meshes.prepare(path, refuse)
        assert refusal.value.reason == "transmissive_material"
    other = kit.textured_glb(tmp_path / "b.glb", PICTURE)
    assert meshes.prepare(other, refuse).levels  # nothing of the kind
    assert "transmission" not in settings_record(kit.KEEP)["own_materials"]
    words = ["assets", str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--own-materials"]
    ended = trilight([*words, "--json"])
    assert ended.exit_code == 0, ended.exception
    (said,) = json.loads(ended.stdout)["unread"].values()
    opaque = "transmission of materials: surfaces are opaque"
    assert said == ["normal map of materials: not shown", opaque]


def test_a_level_over_its_bound_goes_without_and_one_far_from_its_source_is_told(
    tmp_path: Path,
) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8)
    path = kit.textured_glb(tmp_path / "a.glb", kit.picture_bytes(noise))
    strict = OwnMaterialSettings(keep=True, texels=4, max_colour_error=1e-3)
    asset = meshes.prepare(path, AssetSettings(own_materials=strict))
    assert asset.materials is not None and asset.materials.reason == "colours_changed"
    assert all(level.skin is None for level in asset.levels)
    ball = meshes.sphere(rings=9, columns=16)
    path = kit.textured_glb(tmp_path / "b.glb", PICTURE, ball.positions[:, [0, 2]], ball)
    source = read_source(path, kit.KEEP.read_limits)
    mesh, _ = orient_outward(clean(normalize(load_mesh(source))))
    lax = dataclasses.replace(kit.OWN, max_colour_error=1.0)
    surface, _ = read_source_surface(source, Surface(mesh, np.zeros((1, 3))), lax)
    level = meshes.prepare(path, kit.KEEP).levels[0]
    assert add_skin(level, surface, lax).skin is not None
    with pytest.raises(Rejected, match="colours_missed"):
        # shrunk behind the back of its own measure
        add_skin(dataclasses.replace(level, positions=0.8 * level.positions), surface, lax)


GLOW = AssetSettings(own_materials=dataclasses.replace(kit.OWN, emission=True))
UPPER, LOWER = 200, 100
HALVES = np.repeat(np.repeat(np.array([[UPPER], [LOWER]], np.uint8), 32, 0), 64, 1)
"""The upper half brighter than the lower one."""
LIGHT = kit.picture_bytes(np.repeat(HALVES[..., None], 3, axis=2) * np.array([1, 1, 0], np.uint8))


def glb(folder: Path, strength: float = 1.0) -> Path:
    tree, buffer = kit.textured_tree(LIGHT)
    tree["materials"][0] |= {"emissiveFactor": [1, 0.5, 1], "emissiveTexture": {"index": 0}}
    extension = {"emissiveStrength": strength}
    tree["materials"][0]["extensions"] = {"KHR_materials_emissive_strength": extension}
    return meshes.write_glb(folder / "a.glb", tree, buffer)


def usd(folder: Path) -> Path:
    def glowing(stage: Usd.Stage) -> None:
        kit.connect_texture(stage, "./tex.png", {"emissiveColor": "rgb"})
        kit.set_inputs(stage, kit.TEXTURE, {"scale": Gf.Vec4f(1, 0.5, 1, 1)})

    return kit.textured_usd(folder / "a.usda", LIGHT, glowing)


def obj(folder: Path) -> Path:
    mtl = "Kd 1 1 1\nKe 1 0.5 1\nmap_Ke its picture.png\n"
    return kit.textured_obj(folder / "o" / "a.obj", LIGHT, mtl)


def emission(path: Path) -> tuple[NDArray, TriangleMesh]:
    asset = meshes.prepare(path, GLOW)
    assert asset.materials is not None and "emission" not in asset.materials.lost
    level = asset.levels[0]
    assert level.skin is not None and level.skin.emission is not None
    return level.skin.emission, level_mesh(level)


@for_each("write", [glb, usd, obj])
def test_a_triangle_emits_the_mean_of_the_map_over_it(
    tmp_path: Path, write: Callable[[Path], Path]
) -> None:
    """Of a square cut along its diagonal: three quarters of one half, and a quarter of the other.

    To the 36 points of a triangle: one of them is 2.8 % of it. Materials that are off cost nothing,
    and what is lost is named.
    """
    path = write(tmp_path)
    found, mesh = emission(path)
    high, low = linear_from_srgb8()[[UPPER, LOWER]]
    above = mesh.corners.mean(axis=1)[:, 2] > 0
    wanted = np.where(above, 0.75 * high + 0.25 * low, 0.25 * high + 0.75 * low)
    assert np.abs(found - wanted[:, None] * [1, 0.5, 0]).max() < 0.03 * (high - low) + 1e-3
    plain, glows = meshes.prepare(path, kit.KEEP), meshes.prepare(path, GLOW)
    assert plain.materials is not None and "emission" in plain.materials.lost
    assert b"emission_" not in encode_asset(plain)
    assert meshes.geometry(plain) == meshes.geometry(glows)
    ours, theirs = plain.levels[0].skin, glows.levels[0].skin
    assert ours is not None and theirs is not None and ours.packed == theirs.packed
    again = decode_asset(encode_asset(glows)).levels[0].skin
    assert again is not None and again.emission is not None
    assert np.array_equal(again.emission, found)


def test_strength_scales_it_and_a_missing_picture_of_it_costs_no_material(tmp_path: Path) -> None:
    once, _ = emission(glb(tmp_path))
    often, _ = emission(glb(tmp_path, strength=12.5))
    assert np.allclose(often, 12.5 * once)
    path = obj(tmp_path)
    (path.parent / "its picture.png").unlink()
    assert meshes.prepare(path, kit.KEEP).levels[0].skin is not None
    found = meshes.prepare(path, GLOW).materials
    assert found is not None and found.reason == "texture_missing"


def test_what_is_far_darker_than_the_brightest_triangle_emits_nothing(tmp_path: Path) -> None:
    ball = meshes.sphere(rings=6, columns=9)
    uv = np.where(ball.positions[:, 2:] > 0.2, [[0.5, 0.75]], [[0.5, 0.25]])
    halves = np.repeat(np.array([[[255] * 3], [[20] * 3]], np.uint8), 2, 1)
    tree, buffer = kit.textured_tree(kit.picture_bytes(halves), uv, ball)
    tree["materials"][0] |= {"emissiveFactor": [1, 1, 1], "emissiveTexture": {"index": 0}}
    found, mesh = emission(meshes.write_glb(tmp_path / "a.glb", tree, buffer))
    height = mesh.corners[..., 2]
    assert not found[height.max(axis=1) < 0].any()
    assert found[height.min(axis=1) > 0.3].all()
