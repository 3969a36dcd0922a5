"""Normal maps of objects, from each format to the textures of a level."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pxr import Gf, Usd

from storage.records.asset import Asset, decode_asset, encode_asset
from storage.records.lookup import mapped_normals, texture_values, u_directions
from storage.settings.described import settings_record
from tests.for_each import for_each
from tests.pipeline.assets.meshes_by_hand import prepare, write_glb
from tests.pipeline.assets.source_materials.textured_kit import (
    KEEP,
    OWN,
    UV_UP,
    picture_bytes,
    textured_obj,
    textured_tree,
)
from tests.pipeline.assets.source_materials.usd_kit import TEXTURE, set_inputs, textured_usd
from tests.pipeline.foreign.gltf.gltf_writer import GltfWriter

MAPS = dataclasses.replace(KEEP, own_materials=dataclasses.replace(OWN, normal_maps=True))
PLACES = np.array([(-0.25, 0.25), (0.25, 0.25), (-0.25, -0.25), (0.25, -0.25)])
"""Right and up on the square, in the order of the picture."""
SLOPES = np.array([(0.5, 0.1), (-0.4, 0.3), (0.0, -0.6), (0.0, 0.0)])
"""x and y of the map in its quarters, the top row first."""
STEP = 2 / 255
"""Two roundings to 8 bits: of the source and of the level."""
RIGHT, UP, FRONT = np.array([1.0, 0, 0]), np.array([0, 0, 1.0]), np.array([0, -1.0, 0])


def _normals(slopes: NDArray) -> NDArray[np.float64]:
    rest = np.sqrt(1 - np.square(slopes).sum(axis=1, keepdims=True))
    return np.concatenate([slopes, rest], axis=1)


def _picture(values: ArrayLike | None = None) -> bytes:
    """Return quarters of 8 x 8 texels with the normals of SLOPES, or other codes [4, 3]."""
    codes = np.round((_normals(SLOPES) + 1) / 2 * 255) if values is None else np.asarray(values)
    quarters = codes.reshape(2, 2, 3).astype(np.uint8)
    return picture_bytes(np.repeat(np.repeat(quarters, 8, axis=0), 8, axis=1))


def _glb(path: Path, uv: ArrayLike = UV_UP, tangent: ArrayLike | None = None, **info: Any) -> Path:
    tree, buffer = textured_tree(_picture(), uv)
    material = tree["materials"][0]
    material["normalTexture"] = {"index": 0, **info}
    material["pbrMetallicRoughness"] = {"baseColorFactor": [0.5, 0.5, 0.5, 1]}
    if tangent is not None:
        file = GltfWriter(tree=tree, data=bytearray(buffer))
        attributes = tree["meshes"][0]["primitives"][0]["attributes"]
        attributes["TANGENT"] = file.accessor(np.tile(np.asarray(tangent), (4, 1)), "f4")
        buffer = bytes(file.data)
        tree["buffers"][0]["byteLength"] = len(buffer)
    return write_glb(path, tree, buffer)


def _usd(path: Path, scale: float | None = 2.0) -> Path:
    def change(stage: Usd.Stage) -> None:
        if scale is not None:
            vectors = {"scale": Gf.Vec4f(scale, scale, scale, 1), "bias": Gf.Vec4f(-1, -1, -1, 0)}
            set_inputs(stage, TEXTURE, vectors)

    return textured_usd(path, _picture(), change, connect={"normal": "rgb"})


def _shown(asset: Asset, places: NDArray = PLACES) -> NDArray[np.float64]:
    """Return the mapped normals [N, 3] of the finest level of an upright square, to the front."""
    level = asset.levels[0]
    assert level.skin is not None and level.skin.normal is not None, asset.materials
    corners = level.positions[level.faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    u = u_directions(corners, level.skin.uv)
    found = []
    for right, up in places:
        for face, (triangle, uv) in enumerate(zip(corners, level.skin.uv, strict=True)):
            flat = np.vstack([triangle[:, [0, 2]].T, np.ones(3)])
            weights = np.linalg.solve(flat, [right, up, 1.0])
            if (weights >= -1e-9).all():
                texels = texture_values(level.skin.normal, weights @ uv)
                normal = mapped_normals(normals[face], u[face], texels)
                found.append(normal * np.sign(normals[face] @ FRONT))
                break
    assert len(found) == len(places)
    return np.array(found)


def _wanted(right: NDArray = RIGHT, up: NDArray = UP, slopes: NDArray = SLOPES) -> NDArray:
    return _normals(slopes) @ np.stack([right, up, FRONT])


def _strong(factor: float) -> NDArray[np.float64]:
    bent = _normals(SLOPES) * [factor, factor, 1]
    return np.asarray((bent / np.linalg.norm(bent, axis=1, keepdims=True))[:, :2])


FORMATS: dict[str, Callable[[Path], Path]] = {
    "glb": lambda folder: _glb(folder / "a.glb"),
    "usd": lambda folder: _usd(folder / "a.usda"),
    "usd without scale": lambda folder: _usd(folder / "a.usda", None),
    "mtl norm": lambda folder: textured_obj(
        folder / "o/a.obj", _picture(), "Kd .5 .5 .5\nnorm its picture.png\n"
    ),
    "mtl map_Kn": lambda folder: textured_obj(
        folder / "o/a.obj", _picture(), "Kd .5 .5 .5\nmap_Kn -bm 1.0 its picture.png\n"
    ),
}


@for_each("form", FORMATS)
def test_a_level_gives_the_map_of_its_source_back(tmp_path: Path, form: str) -> None:
    path = FORMATS[form](tmp_path)
    asset = prepare(path, MAPS)
    assert np.abs(_shown(asset) - _wanted()).max() < STEP
    assert asset.materials is not None and "normal map" not in asset.materials.lost
    (again,) = decode_asset(encode_asset(asset)).levels[:1]
    skin = asset.levels[0].skin
    assert skin is not None and again.skin is not None
    assert again.skin.packed_normal == skin.packed_normal
    plain = prepare(path, KEEP)
    assert plain.materials is not None and plain.levels[0].skin is not None
    assert plain.levels[0].skin.normal is None
    if form != "mtl map_Kn":  # which was a statement that nothing knew
        assert plain.materials.lost == ("normal map",)


def test_frames_follow_coordinates_that_are_mirrored_or_turned_and_stated_tangents(
    tmp_path: Path,
) -> None:
    """The picture lies mirrored or turned by a right angle: so do its places and directions."""
    mirrored = UV_UP * [-1, 1] + [1, 0]
    asset = prepare(_glb(tmp_path / "a.glb", mirrored), MAPS)
    assert np.abs(_shown(asset, PLACES * [-1, 1]) - _wanted(-RIGHT)).max() < STEP
    turned = UV_UP[[3, 0, 1, 2]]  # u grows upwards, v to the left
    asset = prepare(_glb(tmp_path / "b.glb", turned), MAPS)
    places = PLACES[:, ::-1] * [-1, 1]
    assert np.abs(_shown(asset, places) - _wanted(UP, -RIGHT)).max() < STEP
    for sign in (1, -1):  # upwards in glTF is +Y
        asset = prepare(_glb(tmp_path / "c.glb", tangent=[0, 1, 0, sign]), MAPS)
        assert np.abs(_shown(asset) - _wanted(UP, -sign * RIGHT)).max() < STEP
    asset = prepare(_glb(tmp_path / "d.glb", tangent=[np.nan, 0, 0, 1]), MAPS)
    assert np.abs(_shown(asset) - _wanted()).max() < STEP  # that is none: the coordinates count
    asset = prepare(_glb(tmp_path / "e.glb", scale=0.5), MAPS)
    assert np.abs(_shown(asset) - _wanted(slopes=_strong(0.5))).max() < STEP


def test_maps_that_no_one_should_make_are_flat_bent_upright_or_refused(tmp_path: Path) -> None:
    def made(picture: bytes, name: str) -> Path:
        mtl = f"Kd .5 .5 .5\nnorm its picture.png\nbump -bm 2 its picture.png # {name}\n"
        return textured_obj(tmp_path / name / "a.obj", picture, mtl)

    # No length at all, behind the surface, 16 bits of gray (a slope of 45 degrees), and 127s.
    odd = _picture([[128, 128, 128], [255, 128, 0], [128, 128, 255], [127, 127, 255]])
    asset = prepare(made(odd, "odd"), MAPS)
    (level,) = asset.levels[:1]
    assert level.skin is not None and np.isfinite(level.skin.uv).all()
    upright = np.array([[0, 0], [1, 0], [0, 0], [0, 0]]) * np.sqrt(1 - 0.01**2)
    assert np.abs(_shown(asset) - _wanted(slopes=upright)).max() < 2 * STEP
    assert asset.materials is not None and asset.materials.lost == ("height map",)
    flat = prepare(made(_picture([[128, 127, 255]] * 4), "flat"), MAPS).levels[0].skin
    assert flat is not None and flat.normal is None
    deep = picture_bytes(np.full((4, 4), 65535, np.uint16))  # (1, 1, 1)
    gray = prepare(made(deep, "deep"), MAPS)
    assert np.abs(_shown(gray) - _wanted(slopes=np.full((4, 2), 3**-0.5))).max() < 2 * STEP
    cut = prepare(made(_picture()[:60], "cut"), MAPS)
    assert cut.materials is not None and cut.materials.reason == "texture_unreadable"
    no_uv = prepare(_glb(tmp_path / "b.glb", np.zeros((4, 2))), MAPS).levels[0].skin
    assert no_uv is not None and no_uv.normal is None  # no direction in which u grows


def test_todays_value_is_no_part_of_a_record() -> None:
    assert "normal_maps" not in settings_record(KEEP)["own_materials"]
    assert settings_record(MAPS)["own_materials"]["normal_maps"] is True
