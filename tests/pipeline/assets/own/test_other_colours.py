"""Maps of metal and roughness of an MTL, and colours of a PLY."""

from pathlib import Path

import numpy as np
import pytest

from storage.conventions import linear_from_srgb8
from tests.pipeline.assets.meshes_by_hand import geometry, prepare, write_ply
from tests.pipeline.assets.own.test_own_skins import STORED, F
from tests.pipeline.assets.own.textured_kit import (
    KEEP,
    SQUARE,
    lost,
    picture_bytes,
    seen_at,
    textured_obj,
)

NUMBERS = picture_bytes(np.array([[[51, 9, 9], [204, 9, 9]]], np.uint8))
"""Left and right; what is in green and blue is not read, and nothing is sRGB-encoded."""


@pytest.mark.parametrize(("stated", "times"), [("", 1.0), ("Pr 0.5\n", 0.5)])
def test_a_map_of_roughness_is_linear_in_its_first_channel(
    tmp_path: Path, stated: str, times: float
) -> None:
    mtl = f"Kd 0.5 0.5 0.5\n{stated}map_Pr its picture.png\n"
    asset = prepare(textured_obj(tmp_path / "o" / "a.obj", NUMBERS, mtl), KEEP)
    assert abs(seen_at(asset, -0.25, 0, 2)[0] - times * 51 / 255) < STORED
    assert abs(seen_at(asset, 0.25, 0, 2)[0] - times * 204 / 255) < STORED
    assert np.allclose(seen_at(asset, 0.25, 0, 1), F, atol=STORED)


def test_a_map_of_metal_takes_from_the_diffuse_part(tmp_path: Path) -> None:
    mtl = "Kd 0.8 0.8 0.8\nPr 0.3\nmap_Pm its picture.png\n"
    asset = prepare(textured_obj(tmp_path / "o" / "a.obj", NUMBERS, mtl), KEEP)
    for place, metal in ((-0.25, 0.2), (0.25, 0.8)):
        f0 = 0.04 * (1 - metal) + 0.8 * metal
        specular = f0 + (1 - f0) / 21
        assert np.abs(seen_at(asset, place, 0) - 0.8 * (1 - metal) * (1 - specular)).max() < STORED
        assert np.abs(seen_at(asset, place, 0, 1) - specular).max() < STORED
    assert asset.materials is not None and asset.materials.lost == ()


def test_a_map_that_is_missing(tmp_path: Path) -> None:
    path = textured_obj(tmp_path / "o" / "a.obj", NUMBERS, "Pr 1\nmap_Pr gone.png\n")
    assert lost(path) == "texture_missing"


COLOURS = np.array([[255, 0, 0], [0, 188, 0], [0, 0, 255], [255, 255, 255]])


def _coloured_ply(path: Path, of: str, kind: str = "uchar") -> Path:
    """Colours of the vertices of the square, or of its two faces."""
    lines = write_ply(path, SQUARE).read_text().splitlines()
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
    asset = prepare(path, KEEP)
    linear = linear_from_srgb8()[COLOURS]
    middle = 0.5 * (linear[0] + linear[1]) * 0.9 + 0.1 * linear[2]  # near the lower edge
    seen = seen_at(asset, 0.05, -0.4)  # weights 0.45, 0.45 and 0.1
    assert np.abs(seen - middle * (1 - F)).max() < 3 * STORED
    assert geometry(asset) == geometry(prepare(write_ply(tmp_path / "b.ply", SQUARE)))


def test_colours_of_faces(tmp_path: Path) -> None:
    asset = prepare(_coloured_ply(tmp_path / "a.ply", "face"), KEEP)
    linear = linear_from_srgb8()[COLOURS]
    assert np.abs(seen_at(asset, 0.25, -0.25) - linear[0] * (1 - F)).max() < STORED
    assert np.abs(seen_at(asset, -0.25, 0.25) - linear[1] * (1 - F)).max() < STORED


def test_a_ply_without_colours_says_so_and_opens_no_picture(tmp_path: Path) -> None:
    path = write_ply(tmp_path / "a.ply", SQUARE)
    text = path.read_text().replace("element vertex", "comment TextureFile a.png\nelement vertex")
    path.write_text(text)
    assert lost(path) == "no_materials"
