"""Folders of textures and maps: sets by their names, licences as objects have them."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.objects.licences import DEFAULT_ALLOWED
from pipeline.objects.maps.listing import FoundMaps, find_maps
from pipeline.objects.maps.names import named_part
from storage.errors import TrilightError
from storage.records.objects import SKY, TEXTURE
from tests.for_each import for_each
from tests.pipeline.objects.maps.map_files import exr, noise, png


def _find(folder: Path, kind: str = TEXTURE, licence: str | None = None) -> FoundMaps:
    return find_maps(kind, str(folder), licence=licence, allowed_licences=DEFAULT_ALLOWED)


@for_each(
    "stem, part",
    [
        ("wood_floor_diff_4k", ("wood_floor_4k", "base")),
        ("Bricks076_1K_Color", ("Bricks076_1K", "base")),
        ("a/oak-baseColor", ("a/oak", "base")),
        ("oak_Roughness", ("oak", "roughness")),
        ("oak_nor_gl_2k", ("oak_2k", "normal")),
        ("oak_metalness", ("oak", "metallic")),
        ("oak", ("oak", "base")),
        ("color", ("color", "base")),
    ],
)
def test_the_last_word_of_a_name_is_its_part(stem: str, part: tuple[str, str]) -> None:
    assert named_part(stem) == part


def test_sets_are_found_and_the_rest_is_said(tmp_path: Path) -> None:
    for name in ("oak.png", "oak_roughness.png", "deep/tin_col.jpg", "deep/tin_metal.png"):
        png(tmp_path / name, noise(1))
    for name in ("oak_normal.png", "steel_rough.png", "oak_color.png", ".hidden.png"):
        png(tmp_path / name, noise(1))
    (tmp_path / "readme.txt").write_text("no picture")
    found = _find(tmp_path)
    files = {one.record.uid: sorted(one.files) for one in found.maps}
    assert files == {
        "texture:oak": ["base", "roughness"],
        "texture:deep/tin": ["base", "metallic"],
    }
    assert {failure.item: failure.reason for failure in found.failures} == {
        "texture:oak_normal.png": "map_not_used",
        "texture:steel_rough.png": "no_base_colour",
        "texture:oak_color.png": "name_clash",
    }
    assert {one.record.licence for one in found.maps} == {"LicenseRef-user-provided"}


def test_a_catalogue_states_licences_and_silence_is_refused(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        exr(tmp_path / f"{name}.exr", np.ones((1, 2, 3), np.float32))
    (tmp_path / "skies.csv").write_text(
        "uid,path,licence,attribution\na,a.exr,CC-BY-4.0,Ada\nb,b.exr,,\nc,c.exr,CC-BY-NC-4.0,Cy\n"
    )
    found = _find(tmp_path, SKY)
    (only,) = found.maps
    assert (only.record.uid, only.record.licence, only.record.attribution) == (
        "sky:a", "CC-BY-4.0", "Ada",
    )  # fmt: skip
    assert [failure.reason for failure in found.failures] == ["licence_refused"] * 2
    with pytest.raises(TrilightError, match="states the licence of every"):
        _find(tmp_path, SKY, licence="CC0-1.0")


def test_a_stated_licence_holds_for_a_folder_without_a_catalogue(tmp_path: Path) -> None:
    png(tmp_path / "a.png", noise(1))
    assert _find(tmp_path, licence="CC-BY-4.0").maps[0].record.licence == "CC-BY-4.0"
    assert [one.reason for one in _find(tmp_path, licence="CC-BY-NC-4.0").failures] == [
        "licence_refused"
    ]


def test_links_out_of_the_folder_are_refused(tmp_path: Path) -> None:
    outside = png(tmp_path / "outside.png", noise(1))
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.png").symlink_to(outside)
    assert [one.reason for one in _find(tmp_path / "in").failures] == ["link_outside"]
    png(tmp_path / "in" / "b.png", noise(1))
    (tmp_path / "in" / "b_roughness.png").symlink_to(outside)
    found = _find(tmp_path / "in")
    assert [sorted(one.files) for one in found.maps] == [["base"]]
    assert [one.reason for one in found.failures] == ["link_outside"] * 2


def test_a_folder_that_is_not_there_or_empty_is_a_mistake(tmp_path: Path) -> None:
    for place in (tmp_path / "none", Path("https://host/textures")):
        with pytest.raises(TrilightError, match="no such folder on this machine"):
            _find(place)
    with pytest.raises(TrilightError, match=r"holds none; expected .*textures\.csv"):
        _find(tmp_path)
    for name in ("textures.csv", "textures.jsonl"):
        (tmp_path / name).write_text("")
    with pytest.raises(TrilightError, match="expected one catalogue"):
        _find(tmp_path)
