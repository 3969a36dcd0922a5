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

from pipeline.assets.settings import AssetSettings, OwnMaterialSettings
from pipeline.foreign.picture import Picture
from storage.conventions import linear_from_srgb8
from tests.for_each import for_each
from tests.pipeline.assets.meshes_by_hand import (
    OUTSIDE,
    geometry,
    prepare,
    reason_of,
    secret_beside,
    write_glb,
    write_ply,
)
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
    assert reason_of(path, kit.REFUSE) == reason


def test_many_pictures_count_together(tmp_path: Path) -> None:
    tree, buffer = kit.textured_tree(WHOLE)
    metal = tree["materials"][0]["pbrMetallicRoughness"]
    metal["metallicRoughnessTexture"] = {"index": 1}
    tree["textures"].append({"source": 1})
    tree["images"].append(dict(tree["images"][0]))
    path = write_glb(tmp_path / "a.glb", tree, buffer)
    enough = OwnMaterialSettings(keep=True, texels=16, max_pixels=2 * 64 * 64, max_colour_error=1.0)
    materials = prepare(path, AssetSettings(own_materials=enough)).materials
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
    folder = secret_beside(tmp_path, PICTURE)
    for uri in OUTSIDE:
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
    path = write_ply(tmp_path / "a.ply", kit.SQUARE)
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
        assert kit.lost(write_glb(tmp_path / "a.glb", tree, buffer)) == "materials_unreadable"


def test_folded_coordinates_and_one_texel_are_constants(tmp_path: Path) -> None:
    """All corners at one place of a picture, as palettes are used: that colour everywhere."""
    folded = np.full((4, 2), [0.75, 0.25])
    texel = np.array([[[10, 128, 200]]], np.uint8)
    for picture, uv, linear in (
        (PICTURE, folded, [0, 1, 0]),
        (kit.picture_bytes(texel), kit.UV_UP, linear_from_srgb8()[texel[0, 0]]),
    ):
        path = kit.textured_glb(tmp_path / "a.glb", picture, uv)
        skin = prepare(path, kit.KEEP).levels[0].skin
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
    asset = prepare(kit.textured_glb(tmp_path / "a.glb", FORMS[form]), kit.KEEP)
    places = {(-0.25, 0.25): 40, (0.25, 0.25): 200, (-0.25, -0.25): 120, (0.25, -0.25): 250}
    for place, code in places.items():
        wanted = linear_from_srgb8()[code] * (1 - kit.F)
        assert np.abs(kit.seen_at(asset, *place) - wanted).max() < TOLERANCE, place


def test_a_data_uri_holds_a_picture(tmp_path: Path) -> None:
    text = "data:image/png;base64," + base64.b64encode(PICTURE).decode()
    path = kit.textured_gltf(tmp_path / "a.gltf", text)
    kit.assert_corners(prepare(path, kit.KEEP))
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
        asset = prepare(kit.textured_obj(path, NUMBERS, mtl), kit.KEEP)
        assert abs(kit.seen_at(asset, -0.25, 0, 2)[0] - times * 51 / 255) < kit.STORED
        assert abs(kit.seen_at(asset, 0.25, 0, 2)[0] - times * 204 / 255) < kit.STORED
        assert np.allclose(kit.seen_at(asset, 0.25, 0, 1), kit.F, atol=kit.STORED)
    mtl = "Kd 0.8 0.8 0.8\nPr 0.3\nmap_Pm its picture.png\n"
    asset = prepare(kit.textured_obj(path, NUMBERS, mtl), kit.KEEP)
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
    lines = write_ply(path, kit.SQUARE).read_text().splitlines()
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
        asset = prepare(_coloured_ply(tmp_path / "a.ply", "vertex", kind), kit.KEEP)
        middle = 0.5 * (linear[0] + linear[1]) * 0.9 + 0.1 * linear[2]  # near the lower edge
        seen = kit.seen_at(asset, 0.05, -0.4)  # weights 0.45, 0.45 and 0.1
        assert np.abs(seen - middle).max() < 3 * kit.STORED
        assert geometry(asset) == geometry(prepare(write_ply(tmp_path / "b.ply", kit.SQUARE)))
    asset = prepare(_coloured_ply(tmp_path / "a.ply", "face"), kit.KEEP)
    assert np.abs(kit.seen_at(asset, 0.25, -0.25) - linear[0]).max() < kit.STORED
    assert np.abs(kit.seen_at(asset, -0.25, 0.25) - linear[1]).max() < kit.STORED
