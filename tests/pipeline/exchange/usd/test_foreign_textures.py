"""Textures that other programs name in USD: corners, channels, wrapping, and damage."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from pipeline.exchange.loaded_scene import LoadedScene
from pipeline.exchange.usd.read import read_usd
from storage.conventions import linear_from_srgb8
from storage.errors import TrilightError
from storage.records.exr import encode_channels
from tests.for_each import for_each
from tests.pipeline.exchange.exchange_kit import row_at
from tests.pipeline.exchange.strangers_stage import write_stage

RED, GREEN, BLUE, GREY = (200, 0, 0), (0, 200, 0), (0, 0, 200), (100, 100, 100)
PICTURE = np.array([[RED, GREEN], [BLUE, GREY]], np.uint8)
"""The top row first; the stage's floor has u along +X and v along -Y."""

CORNERS = {(-0.5, -0.5): RED, (0.5, -0.5): GREEN, (-0.5, 0.5): BLUE, (0.5, 0.5): GREY}


F = 0.04 + 0.96 / 21
"""What a dielectric of index 1.5 reflects: F0, and the mean of Schlick's rise to 1."""

CODED = 0.005
"""Half a step of 8 sRGB-encoded bits is at most 0.0045 in linear light."""


def linear(srgb: tuple[int, int, int]) -> np.ndarray:
    """Return the diffuse albedo of such a surface by its encoded color."""
    return np.asarray(linear_from_srgb8()[list(srgb)] * (1 - F))


Edit = Callable[[Any, UsdShade.Shader, UsdShade.Shader], None]


def changed(folder: Path, edit: Edit | None = None, pixels: Any = PICTURE) -> LoadedScene:
    """Return the stage of a stranger with another picture, edited (stage, preview, texture)."""
    path = write_stage(folder)
    if pixels is not None:
        Image.fromarray(pixels).save(folder / "tex.png")
    stage = Usd.Stage.Open(str(path))
    shaders = (UsdShade.Shader.Get(stage, f"/W/mat/{name}") for name in ("preview", "texture"))
    if edit is not None:
        edit(stage, *shaders)
    stage.GetRootLayer().Save()
    return read_usd(path, None, None, "LicenseRef-user-provided")


def token(name: str, value: str) -> Edit:
    return lambda stage, preview, texture: texture.CreateInput(name, Sdf.ValueTypeNames.Token).Set(
        value
    )


def test_every_texel_lies_where_usd_puts_it(tmp_path: Path) -> None:
    found = changed(tmp_path)
    for (x, y), colour in CORNERS.items():
        row = row_at(found.scene, x, y)
        assert row[:3] == pytest.approx(linear(colour), abs=CODED), colour
        assert row[3:7] == pytest.approx([F, F, F, 0.3])
    assert not any("texture" in text for text in found.notes)


def test_scale_and_bias_are_applied_in_linear_light_and_bounded(tmp_path: Path) -> None:
    def edit(stage: Any, preview: Any, texture: UsdShade.Shader) -> None:
        for name, value in (("scale", (2, 0.5, 0.5, 1)), ("bias", (0, 0.25, -1, 0))):
            texture.CreateInput(name, Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(*value))

    found = changed(tmp_path, edit)
    grey = linear_from_srgb8()[GREY[0]]
    expected = (1 - F) * np.array([2 * grey, 0.5 * grey + 0.25, 0])
    assert row_at(found.scene, 0.5, 0.5)[:3] == pytest.approx(expected, abs=CODED)
    assert any("clamped" in text for text in found.notes)


def test_numbers_that_are_none_become_black(tmp_path: Path) -> None:
    """NaN, infinity and negative values in an OpenEXR file."""
    values = np.array([[[np.nan] * 3, [np.inf] * 3], [[-1] * 3, [0.5] * 3]], np.float32)

    def edit(stage: Any, preview: Any, texture: UsdShade.Shader) -> None:
        (tmp_path / "tex.exr").write_bytes(encode_channels({"RGB": values}))
        texture.GetInput("file").Set("./tex.exr")

    found = changed(tmp_path, edit)
    assert any("NaN replaced by 0" in text for text in found.notes)
    rows = [row_at(found.scene, x, y)[0] for x, y in CORNERS]
    assert rows == pytest.approx([0, 1 - F, 0, 0.5 * (1 - F)], abs=CODED)


def test_a_missing_file_takes_its_fallback(tmp_path: Path) -> None:
    def edit(stage: Any, preview: Any, texture: UsdShade.Shader) -> None:
        texture.CreateInput("fallback", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(0.1, 0.2, 0.3, 1))
        texture.GetInput("file").Set("./gone.png")

    found = changed(tmp_path, edit)
    assert row_at(found.scene, 0, 0.1)[:3] == pytest.approx((1 - F) * np.array([0.1, 0.2, 0.3]))
    assert any("left out: './gone.png' is not" in text for text in found.notes)


def test_a_huge_picture_is_refused(tmp_path: Path) -> None:
    path = write_stage(tmp_path)
    Image.new("L", (9000, 9000)).save(tmp_path / "tex.png")
    with pytest.raises(TrilightError, match=r"tex.png': 9000 x 9000 pixels; expected at most"):
        read_usd(path, None, None, "CC0-1.0")


@for_each("is_there", [False, True])
def test_a_mesh_without_coordinates_takes_the_mean(tmp_path: Path, is_there: bool) -> None:
    """None, or some that are no numbers."""

    def edit(stage: Any, preview: Any, texture: Any) -> None:
        grid = stage.GetPrimAtPath("/W/Grid")
        coordinates = [(float("nan"), 0), (1, 0), (1, 1), (0, 1)]
        UsdGeom.PrimvarsAPI(grid).GetPrimvar("st").Set(coordinates)
        if not is_there:
            grid.RemoveProperty("primvars:st")

    found = changed(tmp_path, edit)
    assert any("no coordinates 'st'" in text for text in found.notes)
    mean = (1 - F) * linear_from_srgb8()[PICTURE].mean(axis=(0, 1))
    assert row_at(found.scene, 0, 0.1)[:3] == pytest.approx(mean, abs=1e-5)


def test_metals_take_their_colour_where_a_texture_says_metal(tmp_path: Path) -> None:
    """One picture for the colour, and its green channel for the metal."""

    def edit(stage: Any, preview: UsdShade.Shader, texture: UsdShade.Shader) -> None:
        texture.CreateOutput("g", Sdf.ValueTypeNames.Float)
        metal = preview.CreateInput("metallic", Sdf.ValueTypeNames.Float)
        metal.ConnectToSource(texture.ConnectableAPI(), "g")

    found = changed(tmp_path, edit)
    share = linear_from_srgb8()[GREEN[1]]  # decoded too: the shader states no space
    plain, metal = row_at(found.scene, -0.5, -0.5), row_at(found.scene, 0.5, -0.5)
    assert plain[:6] == pytest.approx([*linear(RED), F, F, F], abs=CODED)
    head_on = 0.04 * (1 - share) + share * share
    specular = head_on + (1 - head_on) / 21
    assert metal[1] == pytest.approx(share * (1 - share) * (1 - specular), abs=CODED)
    assert metal[4] == pytest.approx(specular, abs=CODED)
