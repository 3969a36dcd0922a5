"""Anybody's pictures: each mistake is a sentence that names the file and what was expected."""

import re
from pathlib import Path

import numpy as np
import pytest

from infra.leaderboard.picture_folder import FolderContestant, folder_contestants
from pipeline.exchange.exports.scenes import picture_name
from storage.errors import TrilightError
from storage.records.exr import encode_channels
from tests.for_each import case
from tests.train.toy import toy_sample

VIEWS = [("000000000", 0), ("000000000", 1), ("000000001", 0), ("000000001", 1)]
WIDTHS = [8, 16]


def picture(seed: int, width: int = 16) -> np.ndarray:
    return np.random.default_rng(seed).random((width, width, 3), np.float32)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "mine").mkdir()
    for row, (key, view) in enumerate(VIEWS):
        write(tmp_path / "mine" / picture_name(key, view), picture(row))
    return tmp_path / "mine"


def write(path: Path, rgb: np.ndarray) -> None:
    path.write_bytes(encode_channels({"RGB": rgb}))


def refusal(folder: Path) -> str:
    with pytest.raises(TrilightError) as refused:
        FolderContestant(folder, VIEWS, WIDTHS)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_pictures_are_shown_as_they_are_at_their_one_width(folder: Path) -> None:
    rgb = picture(2)
    rgb[3, 4] = [-0.001, 0, 1e5]  # networks of logarithms give a little less than nothing
    alpha = np.full((16, 16), 0.5, np.float32)
    channels = dict(zip("RGB", np.moveaxis(rgb, -1, 0).copy(), strict=True)) | {"A": alpha}
    (folder / picture_name(*VIEWS[2])).write_bytes(encode_channels(channels))
    one = FolderContestant(folder, VIEWS, WIDTHS)
    assert one.name == "pictures of mine" and one.why_not(16) == ""
    assert one.why_not(8) == "its pictures have 16 pixels"
    shown = one.shown(toy_sample(1), 16, timed=True)
    assert shown.first_s is None
    np.testing.assert_array_equal(shown.radiance_VRR3[0], np.maximum(rgb, 0))
    np.testing.assert_array_equal(shown.radiance_VRR3[1], picture(3))
    before = one.digest(*VIEWS[0])
    write(folder / picture_name(*VIEWS[0]), picture(9))
    after = FolderContestant(folder, VIEWS, WIDTHS)
    assert after.digest(*VIEWS[0]) != before and after.digest(*VIEWS[1]) == one.digest(*VIEWS[1])


def test_missing_pictures_are_counted_and_the_first_is_named(folder: Path, tmp_path: Path) -> None:
    for name in VIEWS[1:3]:
        (folder / picture_name(*name)).unlink()
    said = refusal(folder)
    assert "2 of 4 pictures are missing, the first is 000000000_view_1.exr" in said
    assert "--form exr" in said and "--scenes" in said
    assert "no such folder; expected one" in refusal(tmp_path / "nowhere")


def test_wrong_sizes_are_said(folder: Path) -> None:
    for rgb, said in [
        (picture(0, 12), "000000001_view_0.exr: 12 x 12 pixels; expected 8 x 8 or 16 x 16"),
        (picture(0)[:8], "16 x 8 pixels; expected 8 x 8 or 16 x 16"),
        (picture(0, 8), "several widths .*view_0.exr has 16, 000000001_view_0.exr has 8"),
    ]:
        with case(said):
            write(folder / picture_name(*VIEWS[2]), np.ascontiguousarray(rgb))
            assert re.search(said, refusal(folder))


def test_values_that_are_no_radiance_are_said_with_their_place(folder: Path) -> None:
    for bad in [np.nan, np.inf, -1.0]:
        with case(bad):
            rgb = picture(0)
            rgb[5, 6, 1] = rgb[7, 8, 0] = bad
            write(folder / picture_name(*VIEWS[2]), rgb)
            said = refusal(folder)
            assert "000000001_view_0.exr: row 5, column 6" in said and "channel G" in said
            assert "2 pixels are like it; expected finite radiance of at least 0" in said


@pytest.mark.parametrize(
    "data",
    [b"", b"\x76\x2f\x31\x01 cut", encode_channels({"Y": picture(0)[..., 0].copy()})],
    ids=["empty", "cut", "grey"],
)
def test_what_is_no_colour_picture_is_said(folder: Path, data: bytes) -> None:
    (folder / picture_name(*VIEWS[2])).write_bytes(data)
    assert "000000001_view_0.exr: no readable OpenEXR picture of channels R, G" in refusal(folder)


def test_two_folders_of_one_name_are_refused(folder: Path) -> None:
    assert list(folder_contestants([folder], VIEWS, WIDTHS)) == ["pictures of mine"]
    with pytest.raises(TrilightError, match="another folder has the same name"):
        folder_contestants([folder, folder], VIEWS, WIDTHS)
