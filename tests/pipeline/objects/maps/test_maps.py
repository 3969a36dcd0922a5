"""Textures and maps from outside: names, licences, resampling, formats; what is wrong says so."""

import io
import itertools
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from pipeline.objects.licences import DEFAULT_ALLOWED
from pipeline.objects.maps.listing import FoundMaps, find_maps
from pipeline.objects.maps.names import named_part
from pipeline.objects.maps.radiance import usable_map
from pipeline.objects.maps.resample import area_means, flux, solid_angle_means
from pipeline.objects.maps.rgbe import rgbe_radiance
from pipeline.objects.maps.texture_set import texture_set
from storage.conventions import linear_from_srgb8
from storage.errors import Rejected, TrilightError
from storage.records.exr import encode_channels
from storage.records.objects import SKY, TEXTURE
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


def hdr(texels: NDArray[np.uint8], *, runs: bool, header: str = "") -> bytes:
    """Return a Radiance picture of mantissas and exponents [H, W, 4]."""
    rows, columns = texels.shape[:2]
    out = io.BytesIO()
    out.write(f"#?RADIANCE\n{header}FORMAT=32-bit_rle_rgbe\n\n-Y {rows} +X {columns}\n".encode())
    for row in texels:
        if not runs:
            out.write(row.tobytes())
            continue
        out.write(bytes([2, 2, columns >> 8, columns & 255]))
        for channel in range(4):
            at = 0
            while at < columns:
                values = row[at : at + 127, channel]
                if (values == values[0]).all():
                    out.write(bytes([128 + len(values), values[0]]))
                else:
                    out.write(bytes([len(values)]) + values.tobytes())
                at += len(values)
    return out.getvalue()


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


@for_each("height", [1, 5, 13, 32, 48])
def test_a_sun_of_a_million_keeps_its_energy(height: int) -> None:
    radiance = sun_map(rows=48)
    found = solid_angle_means(radiance, height)
    assert found.shape == (height, 2 * height, 3)
    np.testing.assert_allclose(flux(found), flux(radiance), rtol=1e-12)  # sums in float64
    if height == 48:
        np.testing.assert_allclose(found, radiance, rtol=1e-12)


def test_means_are_those_of_the_overlaps() -> None:
    """Against a slow twin that cuts both grids into a common one."""
    values = np.random.default_rng(0).random((6, 4, 2))
    fine = np.repeat(np.repeat(values, 10, axis=0), 9, axis=1)  # 60 x 36
    twin = fine.reshape(4, 15, 3, 12, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(area_means(values, 4, 3), twin, rtol=1e-12)


def test_a_constant_map_stays_constant_and_a_small_one_as_it_is() -> None:
    ones = np.ones((7, 14, 3), np.float32)
    np.testing.assert_allclose(solid_angle_means(ones, 3), 1, rtol=1e-12)
    assert usable_map(ones, 64).shape == ones.shape


def test_what_is_wrong_with_a_map_is_said() -> None:
    def wrong(**changes: float) -> np.ndarray:
        radiance = np.ones((4, 8, 3), np.float32)
        radiance[1, 2] = changes["value"]
        return radiance

    cases = {
        "not_a_number": wrong(value=np.nan),
        "infinite_radiance": wrong(value=np.inf),
        "negative_radiance": wrong(value=-1.0),
        "too_bright": wrong(value=2e9),
        "black_map": np.zeros((4, 8, 3), np.float32),
        "not_two_to_one": np.ones((1, 1, 3), np.float32),
    }
    for reason, radiance in cases.items():
        with pytest.raises(Rejected) as found:
            usable_map(radiance, 16)
        assert found.value.reason == reason
    with pytest.raises(Rejected, match="row 1, column 2"):
        usable_map(cases["not_a_number"], 16)
    with pytest.raises(Rejected) as found:
        usable_map(-np.ones((4, 8, 3), np.float32), 16)
    assert found.value.reason == "negative_radiance"
    slightly = wrong(value=-1e-3)
    np.testing.assert_array_equal(usable_map(slightly, 16), np.maximum(slightly, 0))


def _texels(rows: int, columns: int) -> np.ndarray:
    texels = np.random.default_rng(1).integers(2, 256, (rows, columns, 4)).astype(np.uint8)
    texels[..., 3] = 120 + texels[..., 3] % 30
    texels[0, : columns // 2] = (7, 9, 11, 130)  # a run
    texels[1, 1] = (200, 100, 50, 0)  # an exponent of 0 is black
    return texels


@for_each("runs, columns", itertools.product([True, False], [8, 300]))
def test_values_are_mantissa_times_a_power_of_two(runs: bool, columns: int) -> None:
    texels = _texels(3, columns)
    found = rgbe_radiance(hdr(texels, runs=runs), 200)
    expected = texels[..., :3] / 256 * 2.0 ** (texels[..., 3:].astype(int) - 128)
    expected[texels[..., 3] == 0] = 0
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, expected)  # powers of two: exact


def test_damaged_and_foreign_files_are_refused_with_a_reason() -> None:
    whole = hdr(_texels(4, 16), runs=True)
    cases = {
        "not_hdr": [
            b"",
            b"P6 4 4",
            hdr(_texels(2, 16), runs=True, header="EXPOSURE=2.0\n"),
            whole.replace(b"32-bit_rle_rgbe", b"32-bit_rle_xyze"),
            whole.replace(b"-Y 4", b"+Y 4"),
        ],
        "too_many_pixels": [
            whole.replace(b"-Y 4", b"-Y 99999"),
            whole.replace(b"+X 16", b"+X 99999"),
            whole.replace(b"-Y 4", b"-Y 0"),
        ],
        "load_error": [
            whole[:-5],
            whole.replace(b"-Y 4", b"-Y 40"),
            whole.replace(b"+X 16", b"+X 17"),
            whole[: whole.index(b"+X 16") + 6 + 4] + b"\xff" * 400,
            whole[: whole.index(b"+X 16") + 6 + 4] + b"\x00" * 400,
            hdr(np.full((2, 4, 4), 1, np.uint8), runs=False),
        ],
    }
    for reason, files in cases.items():
        for number, data in enumerate(files):
            with pytest.raises(Rejected) as found:
                rgbe_radiance(data, 100)
            assert found.value.reason == reason, (reason, number)


def _flat(value: float, channels: int = 1) -> NDArray[np.float32]:
    return np.full((4, 4, channels), value, np.float32)


def test_a_base_colour_is_a_dielectric_or_a_metal_or_leaves_no_room_for_gloss() -> None:
    made = texture_set({"base": _flat(128 / 255, 3)}, 8)
    linear = linear_from_srgb8()[128]
    specular = 0.04 + 0.96 / 21
    np.testing.assert_allclose(made.specular_rgb, specular, rtol=1e-6)  # float32
    np.testing.assert_allclose(made.diffuse_rgb, linear * (1 - specular), rtol=1e-6)
    assert made.roughness is None
    metal = texture_set({"base": _flat(1.0, 3), "metallic": _flat(1.0)}, 8)
    assert metal.diffuse_rgb.max() == 0
    np.testing.assert_allclose(metal.specular_rgb, 1.0, rtol=1e-6)
    white = texture_set({"base": _flat(1.0, 3), "specular": _flat(0.5)}, 8)
    assert white.diffuse_rgb.min() == 1 and white.specular_rgb.max() == 0
    assert white.specular_rgb.shape == (4, 4, 3)


def test_means_are_of_linear_values_and_of_widths() -> None:
    """Black and white squares are half as bright together, which encoded ones are not."""
    squares: NDArray[np.float32] = np.zeros((8, 8, 1), np.float32)
    squares[::2, 1::2] = squares[1::2, ::2] = 1
    made = texture_set({"base": squares, "specular": _flat(0.0), "roughness": squares}, 2)
    assert made.roughness is not None
    np.testing.assert_allclose(made.diffuse_rgb, 0.5, rtol=1e-6)
    np.testing.assert_allclose(made.roughness, np.sqrt(0.5), rtol=1e-6)


@pytest.mark.parametrize(
    ("shape", "fitted"), [((8, 4), (4, 2)), ((3, 9), (1, 4)), ((2, 2), (2, 2))]
)
def test_proportions_stay_and_parts_of_other_sizes_fit(
    shape: tuple[int, int], fitted: tuple[int, int]
) -> None:
    base = np.full((*shape, 3), 1, np.float32)
    made = texture_set({"base": base, "roughness": _flat(0.3)}, 4)
    assert made.diffuse_rgb.shape[:2] == fitted
    assert made.roughness is not None and made.roughness.shape == (*fitted, 1)


def test_the_content_is_the_base_colour() -> None:
    base = _flat(0.5, 3)
    alone, rough = texture_set({"base": base}, 8), texture_set({"base": base, "roughness": base}, 2)
    assert alone.content_sha256 == rough.content_sha256
    assert texture_set({"base": base * 0.9}, 8).content_sha256 != alone.content_sha256
