"""Pictures, maps and coordinates as people really have them: read, or lost with a reason."""

import base64
import dataclasses
import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pxr import Gf, Usd

from pipeline.assets.settings import AssetSettings, OwnMaterialSettings
from pipeline.foreign.picture import Picture
from storage.conventions import linear_from_srgb8
from storage.records.asset import Asset, decode_asset, encode_asset
from storage.records.lookup import mapped_normals, texture_values, u_directions
from storage.settings.described import settings_record
from tests.for_each import for_each
from tests.pipeline.assets import meshes_by_hand as meshes
from tests.pipeline.assets.source_materials import textured_kit as kit

TOLERANCE = 0.02
"""JPEG and a palette of few colours are off by a few of 255 steps, near white a hundredth each."""
PICTURE = kit.picture_bytes(kit.CORNERS)


def _png_that_claims(width: int, height: int) -> bytes:
    """Return a PNG whose header promises far more than its few bytes hold."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        body = kind + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"0" * 99))


WHOLE = kit.picture_bytes(np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8))
UNREADABLE: dict[str, tuple[str, bytes]] = {
    "cut off": ("texture_unreadable", WHOLE[: len(WHOLE) // 2]),
    "no picture": ("texture_unreadable", b"GIF? no"),
    "nothing": ("texture_unreadable", b""),
    "16k": ("texture_too_large", _png_that_claims(16384, 16384)),
    "a bomb": ("texture_too_large", _png_that_claims(200_000, 200_000)),
    "a lie": ("texture_unreadable", _png_that_claims(4096, 4096)),
}


@for_each("name", UNREADABLE)
def test_bad_pictures_are_lost_with_a_reason(tmp_path: Path, name: str) -> None:
    reason, data = UNREADABLE[name]
    path = kit.textured_glb(tmp_path / "a.glb", data)
    assert kit.lost(path) == reason
    assert meshes.reason_of(path, kit.REFUSE) == reason


def test_many_pictures_count_together(tmp_path: Path) -> None:
    tree, buffer = kit.textured_tree(WHOLE)
    metal = tree["materials"][0]["pbrMetallicRoughness"]
    metal["metallicRoughnessTexture"] = {"index": 1}
    tree["textures"].append({"source": 1})
    tree["images"].append(dict(tree["images"][0]))
    path = meshes.write_glb(tmp_path / "a.glb", tree, buffer)
    enough = OwnMaterialSettings(keep=True, texels=16, max_pixels=2 * 64 * 64, max_colour_error=1.0)
    materials = meshes.prepare(path, AssetSettings(own_materials=enough)).materials
    assert materials is not None and materials.reason == ""
    less = dataclasses.replace(enough, max_pixels=2 * 64 * 64 - 1)
    assert kit.lost(path, AssetSettings(own_materials=less)) == "texture_too_large"


def test_a_halved_picture_is_its_mean_in_linear_light() -> None:
    """Of an odd number of rows and more than one strip of them."""
    codes = np.random.default_rng(1).integers(0, 256, (301, 6, 4)).astype(np.uint8)
    picture = Picture(values=codes, is_srgb=True)
    linear = picture.linear(codes).astype(np.float64)
    wanted = linear[:300].reshape(150, 2, 3, 2, 4).mean(axis=(1, 3))
    assert np.abs(picture.level(1)[:150] - wanted).max() < 1e-6
    assert picture.level(1).shape == (151, 3, 4)
    assert np.abs(picture.level(1)[150] - linear[300].reshape(3, 2, 4).mean(axis=1)).max() < 1e-6


def test_pictures_of_a_gltf_or_an_mtl_do_not_lead_out(tmp_path: Path) -> None:
    folder = meshes.secret_beside(tmp_path, PICTURE)
    for uri in meshes.OUTSIDE:
        assert kit.lost(kit.textured_gltf(folder / "a.gltf", uri)) == "texture_outside", uri
    for name in ("../secret.png", "..\\secret.png", "/etc/hostname"):
        path = kit.textured_obj(folder / "a.obj", b"", mtl=f"map_Kd {name}\n")
        assert kit.lost(path) == "texture_outside", name


def test_pictures_mtl_files_and_coordinates_that_are_missing_or_make_no_sense(
    tmp_path: Path,
) -> None:
    assert kit.lost(kit.textured_gltf(tmp_path / "a.gltf", "gone.png")) == "texture_missing"
    for mtl in ("map_Kd gone.png\n", "Pr 1\nmap_Pr gone.png\n"):
        path = kit.textured_obj(tmp_path / "o" / "a.obj", b"", mtl=mtl)
        assert kit.lost(path) == "texture_missing"
    (tmp_path / "o" / "a.mtl").unlink()
    assert kit.lost(path) == "texture_missing"
    for mtl in ("Kd red green\n", "Kd nan 0 0\n", "Kd 1 2\n"):
        path = kit.textured_obj(tmp_path / "o" / "a.obj", b"", mtl=mtl)
        assert kit.lost(path) == "materials_unreadable"
    path.write_text(path.read_text().replace("usemtl it is", "usemtl another"))
    assert kit.lost(path) == "materials_unreadable"
    assert kit.lost(kit.textured_glb(tmp_path / "a.glb", PICTURE, None)) == "no_texture_coordinates"
    broken = np.where(kit.UV_UP == 1, np.inf, kit.UV_UP)
    path = kit.textured_glb(tmp_path / "b.glb", PICTURE, broken)
    assert kit.lost(path) == "texture_coordinates_not_finite"
    # A comment of a PLY that names a picture is no material, and no picture is opened.
    path = meshes.write_ply(tmp_path / "a.ply", kit.SQUARE)
    comment = "comment TextureFile a.png\nelement vertex"
    path.write_text(path.read_text().replace("element vertex", comment))
    assert kit.lost(path) == "no_materials"


def test_materials_that_are_malformed(tmp_path: Path) -> None:
    changes: list[Callable[[dict[str, Any]], None]] = [
        lambda tree: tree.update(textures=[{"source": 7}]),
        lambda tree: tree.update(textures=[]),
        lambda tree: tree.update(images=["picture"]),
        lambda tree: tree.update(materials=[{"pbrMetallicRoughness": {"baseColorFactor": [1]}}]),
        lambda tree: tree.update(materials=[7]),
    ]
    for change in changes:
        tree, buffer = kit.textured_tree(PICTURE)
        change(tree)
        path = meshes.write_glb(tmp_path / "a.glb", tree, buffer)
        assert kit.lost(path) == "materials_unreadable"


def test_folded_coordinates_and_one_texel_are_constants(tmp_path: Path) -> None:
    """All corners at one place of a picture, as palettes are used: that colour everywhere."""
    folded = np.full((4, 2), [0.75, 0.25])
    texel = np.array([[[10, 128, 200]]], np.uint8)
    for picture, uv, linear in (
        (PICTURE, folded, [0, 1, 0]),
        (kit.picture_bytes(texel), kit.UV_UP, linear_from_srgb8()[texel[0, 0]]),
    ):
        path = kit.textured_glb(tmp_path / "a.glb", picture, uv)
        skin = meshes.prepare(path, kit.KEEP).levels[0].skin
        assert skin is not None and [t.texels.shape[:2] for t in skin.textures] == [(1, 1)] * 3
        wanted = np.asarray(linear) * (1 - kit.F)
        assert np.allclose(skin.textures[0].texels[0, 0], wanted, atol=1e-6)


GREY = np.array([[40, 200], [120, 250]], np.uint8)
LARGE = np.kron(GREY, np.ones((16, 16), np.uint8))
FORMS: dict[str, bytes] = {
    "grey": kit.picture_bytes(GREY),
    "16 bits": kit.picture_bytes(GREY.astype(np.uint16) * 257),
    "floats": kit.picture_bytes(linear_from_srgb8()[GREY].astype(np.float32), "TIFF"),
    "alpha": kit.picture_bytes(GREY, mode="LA"),
    "palette": kit.picture_bytes(GREY, mode="P"),
    "RGBA": kit.picture_bytes(GREY, mode="RGBA"),
    "CMYK": kit.picture_bytes(LARGE, "JPEG", "CMYK"),
    "WebP": kit.picture_bytes(LARGE, "WEBP", "RGB"),
}


@for_each("form", FORMS)
def test_forms_of_pictures(tmp_path: Path, form: str) -> None:
    asset = meshes.prepare(kit.textured_glb(tmp_path / "a.glb", FORMS[form]), kit.KEEP)
    places = {(-0.25, 0.25): 40, (0.25, 0.25): 200, (-0.25, -0.25): 120, (0.25, -0.25): 250}
    for place, code in places.items():
        wanted = linear_from_srgb8()[code] * (1 - kit.F)
        assert np.abs(kit.seen_at(asset, *place) - wanted).max() < TOLERANCE, place


def test_a_data_uri_holds_a_picture(tmp_path: Path) -> None:
    text = "data:image/png;base64," + base64.b64encode(PICTURE).decode()
    path = kit.textured_gltf(tmp_path / "a.gltf", text)
    kit.assert_corners(meshes.prepare(path, kit.KEEP))
    tree = json.loads(path.read_text())
    tree["images"][0]["uri"] = "data:image/png;base64,!"
    path.write_text(json.dumps(tree))
    assert kit.lost(path) in ("texture_unreadable", "materials_unreadable")


NUMBERS = kit.picture_bytes(np.array([[[51, 9, 9], [204, 9, 9]]], np.uint8))
"""Left and right; what is in green and blue is not read, and nothing is sRGB-encoded."""


def test_maps_of_an_mtl_are_linear_in_their_first_channel(tmp_path: Path) -> None:
    path = tmp_path / "o" / "a.obj"
    for stated, times in (("", 1.0), ("Pr 0.5\n", 0.5)):
        mtl = f"Kd 0.5 0.5 0.5\n{stated}map_Pr its picture.png\n"
        asset = meshes.prepare(kit.textured_obj(path, NUMBERS, mtl), kit.KEEP)
        assert abs(kit.seen_at(asset, -0.25, 0, 2)[0] - times * 51 / 255) < kit.STORED
        assert abs(kit.seen_at(asset, 0.25, 0, 2)[0] - times * 204 / 255) < kit.STORED
        assert np.allclose(kit.seen_at(asset, 0.25, 0, 1), kit.F, atol=kit.STORED)
    mtl = "Kd 0.8 0.8 0.8\nPr 0.3\nmap_Pm its picture.png\n"
    asset = meshes.prepare(kit.textured_obj(path, NUMBERS, mtl), kit.KEEP)
    for place, metal in ((-0.25, 0.2), (0.25, 0.8)):
        f0 = 0.04 * (1 - metal) + 0.8 * metal
        specular = f0 + (1 - f0) / 21
        diffuse = 0.8 * (1 - metal) * (1 - specular)
        assert np.abs(kit.seen_at(asset, place, 0) - diffuse).max() < kit.STORED
        assert np.abs(kit.seen_at(asset, place, 0, 1) - specular).max() < kit.STORED
    assert asset.materials is not None and asset.materials.lost == ()


COLOURS = np.array([[255, 0, 0], [0, 188, 0], [0, 0, 255], [255, 255, 255]])


def _coloured_ply(path: Path, of: str, kind: str = "uchar") -> Path:
    """Colours of the vertices of the square, or of its two faces."""
    lines = meshes.write_ply(path, kit.SQUARE).read_text().splitlines()
    fields = [f"property {kind} {name}" for name in ("red", "green", "blue")]
    at = lines.index("element face 2" if of == "vertex" else "end_header")
    start = lines.index("end_header") + 1
    values = COLOURS if kind == "uchar" else COLOURS / 255
    for count, row in enumerate(range(4) if of == "vertex" else range(4, 6)):
        lines[start + row] += " " + " ".join(f"{value:g}" for value in values[count])
    path.write_text("\n".join([*lines[:at], *fields, *lines[at:]]) + "\n")
    return path


def test_colours_of_vertices_are_interpolated_in_linear_light_and_faces_have_theirs(
    tmp_path: Path,
) -> None:
    linear = linear_from_srgb8()[COLOURS] * (1 - kit.F)
    for kind in ("uchar", "float"):
        asset = meshes.prepare(_coloured_ply(tmp_path / "a.ply", "vertex", kind), kit.KEEP)
        middle = 0.5 * (linear[0] + linear[1]) * 0.9 + 0.1 * linear[2]  # near the lower edge
        seen = kit.seen_at(asset, 0.05, -0.4)  # weights 0.45, 0.45 and 0.1
        assert np.abs(seen - middle).max() < 3 * kit.STORED
        plain = meshes.prepare(meshes.write_ply(tmp_path / "b.ply", kit.SQUARE))
        assert meshes.geometry(asset) == meshes.geometry(plain)
    asset = meshes.prepare(_coloured_ply(tmp_path / "a.ply", "face"), kit.KEEP)
    assert np.abs(kit.seen_at(asset, 0.25, -0.25) - linear[0]).max() < kit.STORED
    assert np.abs(kit.seen_at(asset, -0.25, 0.25) - linear[1]).max() < kit.STORED


MAPS = dataclasses.replace(kit.KEEP, own_materials=dataclasses.replace(kit.OWN, normal_maps=True))
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
    return kit.picture_bytes(np.repeat(np.repeat(quarters, 8, axis=0), 8, axis=1))


def _glb(
    path: Path, uv: ArrayLike = kit.UV_UP, tangent: ArrayLike | None = None, **info: Any
) -> Path:
    tangents = None if tangent is None else np.tile(np.asarray(tangent), (4, 1))
    tree, buffer = kit.textured_tree(_picture(), uv, tangents=tangents)
    material = tree["materials"][0]
    material["normalTexture"] = {"index": 0, **info}
    material["pbrMetallicRoughness"] = {"baseColorFactor": [0.5, 0.5, 0.5, 1]}
    return meshes.write_glb(path, tree, buffer)


def _usd(path: Path, scale: float | None = 2.0) -> Path:
    def change(stage: Usd.Stage) -> None:
        if scale is not None:
            vectors = {"scale": Gf.Vec4f(scale, scale, scale, 1), "bias": Gf.Vec4f(-1, -1, -1, 0)}
            kit.set_inputs(stage, kit.TEXTURE, vectors)

    return kit.textured_usd(path, _picture(), change, connect={"normal": "rgb"})


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
        face, weights = kit.find_triangle(level, right, up)
        texels = texture_values(level.skin.normal, weights @ level.skin.uv[face])
        normal = mapped_normals(normals[face], u[face], texels)
        found.append(normal * np.sign(normals[face] @ FRONT))
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
    "mtl norm": lambda folder: kit.textured_obj(
        folder / "o/a.obj", _picture(), "Kd .5 .5 .5\nnorm its picture.png\n"
    ),
    "mtl map_Kn": lambda folder: kit.textured_obj(
        folder / "o/a.obj", _picture(), "Kd .5 .5 .5\nmap_Kn -bm 1.0 its picture.png\n"
    ),
}


@for_each("form", FORMATS)
def test_a_level_gives_the_map_of_its_source_back(tmp_path: Path, form: str) -> None:
    path = FORMATS[form](tmp_path)
    asset = meshes.prepare(path, MAPS)
    assert np.abs(_shown(asset) - _wanted()).max() < STEP
    assert asset.materials is not None and "normal map" not in asset.materials.lost
    (again,) = decode_asset(encode_asset(asset)).levels[:1]
    skin = asset.levels[0].skin
    assert skin is not None and again.skin is not None
    assert again.skin.packed == skin.packed and skin.normal is not None
    plain = meshes.prepare(path, kit.KEEP)
    assert plain.materials is not None and plain.levels[0].skin is not None
    assert plain.levels[0].skin.normal is None
    if form != "mtl map_Kn":  # which was a statement that nothing knew
        assert plain.materials.lost == ("normal map",)


def test_frames_follow_coordinates_that_are_mirrored_or_turned_and_stated_tangents(
    tmp_path: Path,
) -> None:
    """The picture lies mirrored or turned by a right angle: so do its places and directions."""
    mirrored = kit.UV_UP * [-1, 1] + [1, 0]
    asset = meshes.prepare(_glb(tmp_path / "a.glb", mirrored), MAPS)
    assert np.abs(_shown(asset, PLACES * [-1, 1]) - _wanted(-RIGHT)).max() < STEP
    turned = kit.UV_UP[[3, 0, 1, 2]]  # u grows upwards, v to the left
    asset = meshes.prepare(_glb(tmp_path / "b.glb", turned), MAPS)
    places = PLACES[:, ::-1] * [-1, 1]
    assert np.abs(_shown(asset, places) - _wanted(UP, -RIGHT)).max() < STEP
    for sign in (1, -1):  # upwards in glTF is +Y
        asset = meshes.prepare(_glb(tmp_path / "c.glb", tangent=[0, 1, 0, sign]), MAPS)
        assert np.abs(_shown(asset) - _wanted(UP, -sign * RIGHT)).max() < STEP
    asset = meshes.prepare(_glb(tmp_path / "d.glb", tangent=[np.nan, 0, 0, 1]), MAPS)
    assert np.abs(_shown(asset) - _wanted()).max() < STEP  # that is none: the coordinates count
    asset = meshes.prepare(_glb(tmp_path / "e.glb", scale=0.5), MAPS)
    assert np.abs(_shown(asset) - _wanted(slopes=_strong(0.5))).max() < STEP


def test_maps_that_no_one_should_make_are_flat_bent_upright_or_refused(tmp_path: Path) -> None:
    def made(picture: bytes, name: str) -> Path:
        mtl = f"Kd .5 .5 .5\nnorm its picture.png\nbump -bm 2 its picture.png # {name}\n"
        return kit.textured_obj(tmp_path / name / "a.obj", picture, mtl)

    # No length at all, behind the surface, 16 bits of gray (a slope of 45 degrees), and 127s.
    odd = _picture([[128, 128, 128], [255, 128, 0], [128, 128, 255], [127, 127, 255]])
    asset = meshes.prepare(made(odd, "odd"), MAPS)
    (level,) = asset.levels[:1]
    assert level.skin is not None and np.isfinite(level.skin.uv).all()
    upright = np.array([[0, 0], [1, 0], [0, 0], [0, 0]]) * np.sqrt(1 - 0.01**2)
    assert np.abs(_shown(asset) - _wanted(slopes=upright)).max() < 2 * STEP
    assert asset.materials is not None and asset.materials.lost == ("height map",)
    flat = meshes.prepare(made(_picture([[128, 127, 255]] * 4), "flat"), MAPS).levels[0].skin
    assert flat is not None and flat.normal is None
    deep = kit.picture_bytes(np.full((4, 4), 65535, np.uint16))  # (1, 1, 1)
    gray = meshes.prepare(made(deep, "deep"), MAPS)
    assert np.abs(_shown(gray) - _wanted(slopes=np.full((4, 2), 3**-0.5))).max() < 2 * STEP
    cut = meshes.prepare(made(_picture()[:60], "cut"), MAPS)
    assert cut.materials is not None and cut.materials.reason == "texture_unreadable"
    no_uv = meshes.prepare(_glb(tmp_path / "b.glb", np.zeros((4, 2))), MAPS).levels[0].skin
    assert no_uv is not None and no_uv.normal is None  # no direction in which u grows


def test_todays_value_is_no_part_of_a_record() -> None:
    assert "normal_maps" not in settings_record(kit.KEEP)["own_materials"]
    assert settings_record(MAPS)["own_materials"]["normal_maps"] is True
