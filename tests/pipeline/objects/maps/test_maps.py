"""Textures and maps from outside: names, licences, resampling, formats; what is wrong says so."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from pipeline.objects.licences import DEFAULT_ALLOWED
from pipeline.objects.maps.listing import FoundMap, find_maps
from pipeline.objects.maps.prepared import (
    area_means,
    decode_prepared,
    flux,
    prepare_map,
    solid_angle_means,
    texture_set,
    usable_map,
)
from pipeline.objects.maps.texture_names import _parse_name, group_textures
from storage.conventions import linear_from_srgb8
from storage.errors import Rejected, TrilightError
from storage.records.exr import encode_channels
from storage.records.objects import SKY, TEXTURE, Failure
from tests.for_each import for_each


def png(path: Path, texels: NDArray[np.uint8]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(texels).save(path)
    return path


def noise(seed: int, height: int = 4, width: int = 4) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)


def exr(path: Path, radiance: NDArray[np.float32]) -> Path:
    path.write_bytes(encode_channels({"RGB": np.ascontiguousarray(radiance, np.float32)}))
    return path


def sun_map(seed: int = 0, rows: int = 8) -> NDArray[np.float32]:
    radiance = np.random.default_rng(seed).random((rows, 2 * rows, 3)).astype(np.float32)
    radiance[rows // 3, rows] = 1e6
    return radiance


def _find(
    folder: Path, kind: str = TEXTURE, licence: str | None = None
) -> tuple[list[FoundMap], list[Failure]]:
    return find_maps(kind, str(folder), licence=licence, allowed_licences=DEFAULT_ALLOWED)


NAMES = """
    Bricks076_1K_Color                Bricks076_1K             base
    Bricks076_1K-JPG_NormalGL         Bricks076_1K-JPG         normal
    oak_nor_gl_2k                     oak_2k                   normal
    oak_arm_1k                        oak_1k                   orm
    WoodFloor_COL_VAR1_3K             WoodFloor_VAR1_3K        base
    WoodFloor_NRM16_3K                WoodFloor_3K             normal
    Plate_METALNESS_2K_METALNESS      Plate_2K_METALNESS       metallic
    Plate_COL_2K_METALNESS            Plate_2K_METALNESS       base
    Wood_Normal_(2)                   Wood_(2)                 normal
    wood_norm_tex                     wood_tex                 normal
    WoodColor                         Wood                     base
    Wood_Normal_OpenGL                Wood                     normal
    Wood_Roughness_Raw_2k             Wood_2k                  roughness
    Wood_Mixed_AO                     Wood                     occlusion
    vckndbi_Preview                   vckndbi                  preview
    mat_metallicRoughness             mat                      orm
    mat_specularf0                    mat                      other
    tiles_color_2048x2048             tiles_2048x2048          base
    x_BaseColor.1001                  x.1001                   base
    Holz_Höhe_2k                      Holz_2k                  height
    bois_rugosité                     bois                     roughness
    木_法线                           木                       normal
    oak_metalness                     oak                      metallic
    oak                               oak                      base
    color                             color                    base
    roughness/oak                     roughness/oak            roughness
"""
"""Names of files without their suffixes, with the texture and the part that they are of."""


def test_the_words_of_a_name_are_its_part() -> None:
    for stem, texture, part in map(str.split, NAMES.strip().split("\n")):
        named = _parse_name(stem)
        assert ((named.stem, named.part) if named else (stem, "base")) == (texture, part)


def test_sets_are_found_and_the_rest_is_said(tmp_path: Path) -> None:
    used = ("oak.png", "oak_roughness.png", "deep/tin_col.jpg", "deep/tin_metal.png")
    for name in (*used, "oak_normal.png", "steel_rough.png", "Oak076.png", ".hidden.png"):
        png(tmp_path / name, noise(1))
    for name in ("readme.txt", "oak.zip", "deep/tin.psd"):
        (tmp_path / name).write_text("no picture")
    maps, failures = _find(tmp_path)
    files = {one.record.uid: sorted(one.files) for one in maps}
    expected = {"texture:oak": ["base", "roughness"], "texture:deep/tin": ["base", "metallic"]}
    assert files == expected
    assert {failure.item: failure.reason for failure in failures} == {
        "texture:oak_normal.png": "map_not_used",
        "texture:steel_rough.png": "no_base_colour",
        "texture:Oak076.png": "unknown_map",
        "texture:oak.zip": "unread_format",
        "texture:deep/tin.psd": "unread_format",
    }
    assert {one.record.licence for one in maps} == {"LicenseRef-user-provided"}


@for_each("folder", ["", "deep/"])
def test_folders_of_one_part_each_give_what_names_of_parts_give(
    tmp_path: Path, folder: str
) -> None:
    """With a catalogue as without one; a folder of colors that was named alone has no others."""
    parts = {"base": "Albedo", "roughness": "roughness", "metallic": "metallic"}
    for texture in ("oak", "tin"):
        for part in parts.values():
            png(tmp_path / "folders" / f"{folder}{part}" / f"{texture}.png", noise(1))
            png(tmp_path / "names" / f"{folder}{texture}_{part}.png", noise(1))
    by_folder, by_name = (_find(tmp_path / each) for each in ("folders", "names"))
    assert [sorted(one.files) for one in by_folder[0]] == [sorted(parts)] * 2
    assert [sorted(one.files) for one in by_name[0]] == [sorted(parts)] * 2
    assert by_folder[1] == by_name[1] == []
    rows = [f"{texture},{folder}Albedo/{texture}.png,CC0-1.0" for texture in ("oak", "tin")]
    (tmp_path / "folders" / "textures.csv").write_text("\n".join(["uid,path,licence", *rows]))
    assert [one.files for one in _find(tmp_path / "folders")[0]] == [
        one.files for one in by_folder[0]
    ]
    (alone, _), _ = _find(tmp_path / "folders" / f"{folder}Albedo")
    assert list(alone.files) == ["base"]


def test_folders_of_the_large_collections() -> None:
    for names, textures, unused in (
        ("a.png b.jpg sky.exr", {"a": "a.png", "b": "b.jpg"}, "sky.exr:unknown_map"),
        ("T_W_D.png T_W_N.png T_W_ORM.png T_W_M.png", {"T_W": "T_W_D.png T_W_ORM.png"},
         "T_W_M.png:map_not_used T_W_N.png:map_not_used"),
        ("w_a.png w_b.png w_c.png", {"w_a": "w_a.png", "w_b": "w_b.png", "w_c": "w_c.png"}, ""),
        ("f_col_1.png f_col_2.png f_rough.png f_rough_2.png f_arm.png f_metal.png",
         {"f_1": "f_col_1.png f_metal.png f_rough.png",
          "f_2": "f_col_2.png f_metal.png f_rough_2.png"}, "f_arm.png:map_not_used"),
        ("x/basecolor.png x/diffuse.png x/roughness.png x/normal.png",
         {"x/basecolor": "x/basecolor.png x/roughness.png"},
         "x/diffuse.png:name_clash x/normal.png:map_not_used"),
        ("m.png m_n.png m_s.png", {"m": "m.png"}, "m_n.png:map_not_used m_s.png:map_not_used"),
        ("Albedo_W.png Normal_W.png rock_n_dx11.png", {"Albedo_W": "Albedo_W.png"},
         "Normal_W.png:unknown_map rock_n_dx11.png:unknown_map"),
        ("a_xx0.png b/aaa.png b/bbb.png b/ccc.png c/aaa.png c/bbb.png c/ccc.png",
         {"a_xx0": "a_xx0.png"},
         " ".join(f"{s}/{w * 3}.png:unknown_map" for s in "bc" for w in "abc")),
        ("rough_wall.png metal.png", {"metal": "metal.png", "rough_wall": "rough_wall.png"}, ""),
        ("albedo/o.png roughness/o.png", {"albedo/o": "albedo/o.png roughness/o.png"}, ""),
        ("o_diff.exr o_diff.png o_rough.exr o.png", {"o": "o_diff.png o_rough.exr"},
         "o.png:unknown_map o_diff.exr:name_clash"),
    ):  # fmt: skip
        sets, left = group_textures(names.split())
        assert {stem: " ".join(sorted(files.values())) for stem, files in sets.items()} == textures
        assert " ".join(f"{name}:{reason}" for name, (reason, _) in sorted(left.items())) == unused


def test_packed_pictures_gloss_and_floats_are_parts(tmp_path: Path) -> None:
    packed = np.broadcast_to(np.array([10, 51, 204], np.uint8), (4, 4, 3))
    color = np.full((4, 4, 3), 188, np.uint8)
    linear = linear_from_srgb8()[color]

    def roughness(**files: Path) -> float:
        base = png(tmp_path / "b.png", color)
        data, _ = prepare_map(TEXTURE, {"base": base, **files}, 4)
        return float(decode_prepared(data, "a").arrays["roughness"].mean())

    assert roughness(orm=png(tmp_path / "p.png", packed)) == pytest.approx(0.2)
    assert roughness(gloss=png(tmp_path / "g.png", packed[..., 1])) == pytest.approx(0.8)
    floats = exr(tmp_path / "r.exr", np.full((4, 4, 3), 0.07, np.float32))
    assert roughness(roughness=floats) == pytest.approx(0.07)
    twins = [png(tmp_path / "b.png", color), exr(tmp_path / "b.exr", linear)]
    prepared = [prepare_map(TEXTURE, {"base": path}, 4)[0] for path in twins]
    eight, half = (decode_prepared(data, "a").arrays["diffuse"] for data in prepared)
    np.testing.assert_allclose(eight, half, rtol=1e-5)
    wide = exr(tmp_path / "w.exr", np.full((4, 4, 3), 1.5, np.float32))
    _, unread = prepare_map(TEXTURE, {"base": wide}, 4)
    assert unread == ("values beyond [0, 1] (0 to 1.5) of its base",)
    up = png(tmp_path / "n.png", np.broadcast_to(np.array([140, 120, 254], np.uint8), (4, 4, 3)))
    with pytest.raises(Rejected, match="unit vectors, as of a normal map"):
        prepare_map(TEXTURE, {"base": up}, 4)


def test_licences_are_those_of_the_catalogue_or_the_stated_one(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        exr(tmp_path / f"{name}.exr", np.ones((1, 2, 3), np.float32))
    png(tmp_path / "a.png", noise(1))
    assert _find(tmp_path, licence="CC-BY-4.0")[0][0].record.licence == "CC-BY-4.0"
    refused = _find(tmp_path, licence="CC-BY-NC-4.0")[1]
    assert "licence_refused" in {one.reason for one in refused}
    rows = "a,a.exr,CC-BY-4.0,Ada\nb,b.exr,,\nc,c.exr,CC-BY-NC-4.0,Cy\n"
    (tmp_path / "skies.csv").write_text(f"uid,path,licence,attribution\n{rows}")
    maps, failures = _find(tmp_path, SKY)
    (only,) = maps
    assert (only.record.uid, only.record.licence, only.record.attribution) == (
        "sky:a", "CC-BY-4.0", "Ada",
    )  # fmt: skip
    assert [failure.reason for failure in failures] == ["licence_refused"] * 2
    with pytest.raises(TrilightError, match="states the licence of every"):
        _find(tmp_path, SKY, licence="CC0-1.0")


def test_links_out_of_the_folder_are_refused(tmp_path: Path) -> None:
    outside = png(tmp_path / "outside.png", noise(1))
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.png").symlink_to(outside)
    assert [one.reason for one in _find(tmp_path / "in")[1]] == ["link_outside"]
    png(tmp_path / "in" / "b.png", noise(1))
    (tmp_path / "in" / "b_roughness.png").symlink_to(outside)
    maps, failures = _find(tmp_path / "in")
    assert [sorted(one.files) for one in maps] == [["base"]]
    assert [one.reason for one in failures] == ["link_outside"] * 2


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


@for_each("height", [1, 5, 13, 32, 48])
def test_a_sun_of_a_million_keeps_its_energy(height: int) -> None:
    radiance = sun_map(rows=48)
    found = solid_angle_means(radiance, height)
    assert found.shape == (height, 2 * height, 3)
    np.testing.assert_allclose(flux(found), flux(radiance), rtol=1e-12)  # sums in float64
    if height == 48:
        np.testing.assert_allclose(found, radiance, rtol=1e-12)
    ones = np.ones((7, 14, 3), np.float32)
    np.testing.assert_allclose(solid_angle_means(ones, min(height, 7)), 1, rtol=1e-12)


def test_means_are_those_of_the_overlaps_of_linear_values_and_of_widths() -> None:
    """Against a slow twin that cuts both grids into a common one.

    Black and white squares are half as bright together, which encoded ones are not.
    """
    values = np.random.default_rng(0).random((6, 4, 2))
    fine = np.repeat(np.repeat(values, 10, axis=0), 9, axis=1)  # 60 x 36
    twin = fine.reshape(4, 15, 3, 12, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(area_means(values, 4, 3), twin, rtol=1e-12)
    squares: NDArray[np.float32] = np.zeros((8, 8, 1), np.float32)
    squares[::2, 1::2] = squares[1::2, ::2] = 1
    made = texture_set({"base": squares, "specular": _flat(0.0), "roughness": squares}, 2)
    np.testing.assert_allclose(made.arrays["diffuse"], 0.5, rtol=1e-6)
    np.testing.assert_allclose(made.arrays["roughness"], np.sqrt(0.5), rtol=1e-6)


def _with(value: float) -> NDArray[np.float32]:
    radiance = np.ones((4, 8, 3), np.float32)
    radiance[1, 2] = value
    return radiance


def test_what_is_wrong_with_a_map_is_said_and_a_good_one_is_as_it_is() -> None:
    wrong: list[tuple[str, NDArray[np.float32]]] = [
        ("not_a_number", _with(np.nan)),
        ("infinite_radiance", _with(np.inf)),
        ("negative_radiance", _with(-1.0)),
        ("negative_radiance", -np.ones((4, 8, 3), np.float32)),
        ("too_bright", _with(2e9)),
        ("black_map", np.zeros((4, 8, 3), np.float32)),
        ("not_two_to_one", np.ones((1, 1, 3), np.float32)),
    ]
    for reason, radiance in wrong:
        with pytest.raises(Rejected) as found:
            usable_map(radiance, 16)
        assert found.value.reason == reason
    with pytest.raises(Rejected, match="row 1, column 2"):
        usable_map(_with(np.nan), 16)
    slightly = _with(-1e-3)
    np.testing.assert_array_equal(usable_map(slightly, 16), np.maximum(slightly, 0))


def _flat(value: float, channels: int = 1) -> NDArray[np.float32]:
    return np.full((4, 4, channels), value, np.float32)


def test_a_base_colour_is_a_dielectric_or_a_metal_or_leaves_no_room_for_gloss() -> None:
    made = texture_set({"base": _flat(128 / 255, 3)}, 8)
    linear = linear_from_srgb8()[128]
    specular = 0.04 + 0.96 / 21
    np.testing.assert_allclose(made.arrays["specular"], specular, rtol=1e-6)  # float32
    np.testing.assert_allclose(made.arrays["diffuse"], linear * (1 - specular), rtol=1e-6)
    assert "roughness" not in made.arrays
    metal = texture_set({"base": _flat(1.0, 3), "metallic": _flat(1.0)}, 8)
    assert metal.arrays["diffuse"].max() == 0
    np.testing.assert_allclose(metal.arrays["specular"], 1.0, rtol=1e-6)
    white = texture_set({"base": _flat(1.0, 3), "specular": _flat(0.5)}, 8)
    assert white.arrays["diffuse"].min() == 1 and white.arrays["specular"].max() == 0
    assert white.arrays["specular"].shape == (4, 4, 3)


def test_proportions_stay_parts_of_other_sizes_fit_and_the_content_is_the_base_colour() -> None:
    for shape, fitted in (((8, 4), (4, 2)), ((3, 9), (1, 4)), ((2, 2), (2, 2))):
        base = np.full((*shape, 3), 0.5, np.float32)
        made = texture_set({"base": base, "roughness": _flat(0.3)}, 4)
        assert made.arrays["diffuse"].shape[:2] == fitted
        assert made.arrays["roughness"].shape == (*fitted, 1)
        assert texture_set({"base": base}, 8).content_sha256 == made.content_sha256
        assert texture_set({"base": base * 0.9}, 4).content_sha256 != made.content_sha256
