"""Pictures, maps and coordinates as people really have them: read, or lost with a reason."""

import dataclasses
import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.assets.settings import AssetSettings, OwnMaterialSettings
from pipeline.foreign.picture import Picture
from storage.conventions import linear_from_srgb8
from tests.for_each import for_each
from tests.pipeline.assets.meshes_by_hand import geometry, prepare, reason_of, write_glb, write_ply
from tests.pipeline.assets.meshes_by_hand import prepare as prepare_asset
from tests.pipeline.assets.source_materials import textured_kit as kit

TOLERANCE = 0.02
"""JPEG and a palette of few colours are off by a few of 255 steps, near white a hundredth each."""


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
    materials = prepare_asset(path, AssetSettings(own_materials=enough)).materials
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


OUTSIDE = [
    "../secret.png",
    "a/../../secret.png",
    "%2e%2e/secret.png",
    "/etc/hostname",
    "file:///etc/hostname",
    "http://127.0.0.1:1/a.png",
    "//host/a.png",
    "link.png",
]


@for_each("uri", OUTSIDE)
def test_pictures_do_not_lead_out(tmp_path: Path, uri: str) -> None:
    (tmp_path / "secret.png").write_bytes(kit.picture_bytes(kit.CORNERS))
    folder = tmp_path / "objects"
    folder.mkdir()
    (folder / "link.png").symlink_to(tmp_path / "secret.png")
    assert kit.lost(kit.textured_gltf(folder / "a.gltf", uri)) == "texture_outside"


def test_an_mtl_does_not_lead_out_either(tmp_path: Path) -> None:
    (tmp_path / "secret.png").write_bytes(kit.picture_bytes(kit.CORNERS))
    for name in ("../secret.png", "..\\secret.png", "/etc/hostname"):
        path = kit.textured_obj(tmp_path / "o" / "a.obj", b"", mtl=f"map_Kd {name}\n")
        assert kit.lost(path) == "texture_outside"


def test_pictures_mtl_files_and_coordinates_that_are_missing_or_make_no_sense(
    tmp_path: Path,
) -> None:
    assert kit.lost(kit.textured_gltf(tmp_path / "a.gltf", "gone.png")) == "texture_missing"
    path = kit.textured_obj(tmp_path / "o" / "a.obj", b"", mtl="map_Kd gone.png\n")
    assert kit.lost(path) == "texture_missing"
    (tmp_path / "o" / "a.mtl").unlink()
    assert kit.lost(path) == "texture_missing"
    for mtl in ("Kd red green\n", "Kd nan 0 0\n", "Kd 1 2\n"):
        path = kit.textured_obj(tmp_path / "o" / "a.obj", b"", mtl=mtl)
        assert kit.lost(path) == "materials_unreadable"
    path.write_text(path.read_text().replace("usemtl it is", "usemtl another"))
    assert kit.lost(path) == "materials_unreadable"
    picture = kit.picture_bytes(kit.CORNERS)
    assert kit.lost(kit.textured_glb(tmp_path / "a.glb", picture, None)) == "no_texture_coordinates"
    broken = np.where(kit.UV_UP == 1, np.inf, kit.UV_UP)
    path = kit.textured_glb(tmp_path / "b.glb", picture, broken)
    assert kit.lost(path) == "texture_coordinates_not_finite"


def test_materials_that_are_malformed(tmp_path: Path) -> None:
    changes: list[Callable[[dict[str, Any]], None]] = [
        lambda tree: tree.update(textures=[{"source": 7}]),
        lambda tree: tree.update(textures=[]),
        lambda tree: tree.update(images=["picture"]),
        lambda tree: tree.update(materials=[{"pbrMetallicRoughness": {"baseColorFactor": [1]}}]),
        lambda tree: tree.update(materials=[7]),
    ]
    for change in changes:
        tree, buffer = kit.textured_tree(kit.picture_bytes(kit.CORNERS))
        change(tree)
        assert kit.lost(write_glb(tmp_path / "a.glb", tree, buffer)) == "materials_unreadable"


def test_folded_coordinates_and_one_texel_are_constants(tmp_path: Path) -> None:
    """All corners at one place of a picture, as palettes are used: that colour everywhere."""
    folded = np.full((4, 2), [0.75, 0.25])
    asset = prepare_asset(
        kit.textured_glb(tmp_path / "a.glb", kit.picture_bytes(kit.CORNERS), folded), kit.KEEP
    )
    skin = asset.levels[0].skin
    assert skin is not None and skin.textures[0].texels.shape == (1, 1, 3)
    assert np.allclose(skin.textures[0].texels[0, 0], [0, 1 - kit.F, 0], atol=1e-6)
    data = kit.picture_bytes(np.array([[[10, 128, 200]]], np.uint8))
    skin = prepare_asset(kit.textured_glb(tmp_path / "a.glb", data), kit.KEEP).levels[0].skin
    assert skin is not None and [t.texels.shape[0] for t in skin.textures] == [1, 1, 1]
    wanted = linear_from_srgb8()[[10, 128, 200]] * (1 - kit.F)
    assert np.allclose(skin.textures[0].texels[0, 0], wanted, atol=1e-6)


GREY = np.array([[40, 200], [120, 250]], np.uint8)
DEEP = GREY.astype(np.uint16) * 257
FORMS: dict[str, bytes] = {
    "grey": kit.picture_bytes(GREY),
    "16 bits": kit.picture_bytes(DEEP),
    "floats": kit.picture_bytes(linear_from_srgb8()[GREY].astype(np.float32), "TIFF"),
    "alpha": kit.picture_bytes(GREY, mode="LA"),
    "palette": kit.picture_bytes(GREY, mode="P"),
    "RGBA": kit.picture_bytes(GREY, mode="RGBA"),
    "CMYK": kit.picture_bytes(np.kron(GREY, np.ones((16, 16), np.uint8)), "JPEG", "CMYK"),
    "WebP": kit.picture_bytes(np.kron(GREY, np.ones((16, 16), np.uint8)), "WEBP", "RGB"),
}


@for_each("form", FORMS)
def test_forms_of_pictures(tmp_path: Path, form: str) -> None:
    asset = prepare_asset(kit.textured_glb(tmp_path / "a.glb", FORMS[form]), kit.KEEP)
    places = {(-0.25, 0.25): 40, (0.25, 0.25): 200, (-0.25, -0.25): 120, (0.25, -0.25): 250}
    for place, code in places.items():
        wanted = linear_from_srgb8()[code] * (1 - kit.F)
        assert np.abs(kit.seen_at(asset, *place) - wanted).max() < TOLERANCE, place


def test_a_data_uri_holds_a_picture(tmp_path: Path) -> None:
    import base64

    text = "data:image/png;base64," + base64.b64encode(kit.picture_bytes(kit.CORNERS)).decode()
    asset = prepare_asset(kit.textured_gltf(tmp_path / "a.gltf", text), kit.KEEP)
    assert np.allclose(kit.seen_at(asset, -0.25, -0.25), [1 - kit.F, 0, 0], atol=TOLERANCE)
    tree = json.loads((tmp_path / "a.gltf").read_text())
    tree["images"][0]["uri"] = "data:image/png;base64,!"
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    assert kit.lost(tmp_path / "a.gltf") in ("texture_unreadable", "materials_unreadable")


NUMBERS = kit.picture_bytes(np.array([[[51, 9, 9], [204, 9, 9]]], np.uint8))
"""Left and right; what is in green and blue is not read, and nothing is sRGB-encoded."""


@pytest.mark.parametrize(("stated", "times"), [("", 1.0), ("Pr 0.5\n", 0.5)])
def test_a_map_of_roughness_is_linear_in_its_first_channel(
    tmp_path: Path, stated: str, times: float
) -> None:
    mtl = f"Kd 0.5 0.5 0.5\n{stated}map_Pr its picture.png\n"
    asset = prepare(kit.textured_obj(tmp_path / "o" / "a.obj", NUMBERS, mtl), kit.KEEP)
    assert abs(kit.seen_at(asset, -0.25, 0, 2)[0] - times * 51 / 255) < kit.STORED
    assert abs(kit.seen_at(asset, 0.25, 0, 2)[0] - times * 204 / 255) < kit.STORED
    assert np.allclose(kit.seen_at(asset, 0.25, 0, 1), kit.F, atol=kit.STORED)


def test_a_map_of_metal_takes_from_the_diffuse_part(tmp_path: Path) -> None:
    mtl = "Kd 0.8 0.8 0.8\nPr 0.3\nmap_Pm its picture.png\n"
    asset = prepare(kit.textured_obj(tmp_path / "o" / "a.obj", NUMBERS, mtl), kit.KEEP)
    for place, metal in ((-0.25, 0.2), (0.25, 0.8)):
        f0 = 0.04 * (1 - metal) + 0.8 * metal
        specular = f0 + (1 - f0) / 21
        assert (
            np.abs(kit.seen_at(asset, place, 0) - 0.8 * (1 - metal) * (1 - specular)).max()
            < kit.STORED
        )
        assert np.abs(kit.seen_at(asset, place, 0, 1) - specular).max() < kit.STORED
    assert asset.materials is not None and asset.materials.lost == ()


def test_a_map_that_is_missing(tmp_path: Path) -> None:
    path = kit.textured_obj(tmp_path / "o" / "a.obj", NUMBERS, "Pr 1\nmap_Pr gone.png\n")
    assert kit.lost(path) == "texture_missing"


COLOURS = np.array([[255, 0, 0], [0, 188, 0], [0, 0, 255], [255, 255, 255]])


def _coloured_ply(path: Path, of: str, kind: str = "uchar") -> Path:
    """Colours of the vertices of the square, or of its two faces."""
    lines = write_ply(path, kit.SQUARE).read_text().splitlines()
    fields = [f"property {kind} {name}" for name in ("red", "green", "blue")]
    at = lines.index("element face 2" if of == "vertex" else "end_header")
    rows = range(4) if of == "vertex" else range(4, 6)
    start = lines.index("end_header") + 1
    scale = 1 if kind == "uchar" else 255
    for count, row in enumerate(rows):
        values = COLOURS[count] / scale if scale > 1 else COLOURS[count]
        lines[start + row] += " " + " ".join(f"{value:g}" for value in values)
    path.write_text("\n".join([*lines[:at], *fields, *lines[at:]]) + "\n")
    return path


@pytest.mark.parametrize("kind", ["uchar", "float"])
def test_colours_of_vertices_are_interpolated_in_linear_light(tmp_path: Path, kind: str) -> None:
    path = _coloured_ply(tmp_path / "a.ply", "vertex", kind)
    asset = prepare(path, kit.KEEP)
    linear = linear_from_srgb8()[COLOURS]
    middle = 0.5 * (linear[0] + linear[1]) * 0.9 + 0.1 * linear[2]  # near the lower edge
    seen = kit.seen_at(asset, 0.05, -0.4)  # weights 0.45, 0.45 and 0.1
    assert np.abs(seen - middle * (1 - kit.F)).max() < 3 * kit.STORED
    assert geometry(asset) == geometry(prepare(write_ply(tmp_path / "b.ply", kit.SQUARE)))


def test_colours_of_faces(tmp_path: Path) -> None:
    asset = prepare(_coloured_ply(tmp_path / "a.ply", "face"), kit.KEEP)
    linear = linear_from_srgb8()[COLOURS]
    assert np.abs(kit.seen_at(asset, 0.25, -0.25) - linear[0] * (1 - kit.F)).max() < kit.STORED
    assert np.abs(kit.seen_at(asset, -0.25, 0.25) - linear[1] * (1 - kit.F)).max() < kit.STORED


def test_a_ply_without_colours_says_so_and_opens_no_picture(tmp_path: Path) -> None:
    path = write_ply(tmp_path / "a.ply", kit.SQUARE)
    text = path.read_text().replace("element vertex", "comment TextureFile a.png\nelement vertex")
    path.write_text(text)
    assert kit.lost(path) == "no_materials"
