"""`trilight render --spp`, `--seconds`, `--error`: what is chosen is said, made and recorded."""

import io
import json
from pathlib import Path
from typing import Any

import OpenEXR
import pytest

from infra.render.preview_table import (
    PartCost,
    PictureCosts,
    keep_machine_costs,
    machine_name,
    shipped_table,
)
from pipeline.renders.variant import choose_variant
from tests.command_line import trilight
from tests.for_each import case

pytestmark = pytest.mark.usefixtures("children_here")

WIDE = {"COLUMNS": "400"}


def unwrapped(text: str) -> str:
    return " ".join(text.split())


@pytest.fixture
def words(source: Path, tmp_path: Path) -> list[str]:
    return ["render", str(source), "--out", str(tmp_path / "x.exr"), "--resolution", "32"]


def test_what_is_chosen_is_said_made_and_recorded(words: list[str]) -> None:
    printed = unwrapped(trilight([*words, "--error", "20"], env=WIDE).output)
    scenes = shipped_table().scenes
    assert "--error 20: chosen: " in printed and "a pixel, filter fast; expected" in printed
    assert f"dB in the median of {scenes} scenes" in printed
    assert "noise floor unknown: a preview measures none" in printed
    assert "s after start-up; expected" in printed
    header = OpenEXR.File(io.BytesIO(Path(words[3]).read_bytes()), header_only=True).header()
    assert header["trilight.chosen_for"] == "--error 20"
    assert header["trilight.expected_db"] >= 20 and header["trilight.expected_seconds"] > 0
    assert json.loads(header["trilight.settings"])["spp"] == header["trilight.spp"]
    assert not [name for name in header if "noise_floor" in name]


def test_the_outcome_as_json_holds_what_was_expected_and_what_it_took(words: list[str]) -> None:
    for option, value in (("--seconds", "1e-9"), ("--seconds", "0.05"), ("--error", "0")):
        found = json.loads(trilight([*words, option, value, "--json"]).output)
        with case(f"{option} {value}"):
            assert found["chosen_for"] == f"{option} {value}".replace("1e-9", "1e-09")
            assert found["choice"].startswith(found["chosen_for"])
            assert ("nothing is as quick" in found["choice"]) == (value == "1e-9")
            assert found["picture_seconds"] > 0 and found["expected_seconds"] > 0
            assert "noise_floor_db" not in found


def test_an_orbit_is_chosen_for_each_of_its_pictures(words: list[str], tmp_path: Path) -> None:
    """Pictures of one scene share its loading; a second run keeps them."""
    turn = [*words, "--orbit", "3", "--seconds", "1e-9", "--json"]
    turn[3] = str(tmp_path / "turn")
    found: dict[str, Any] = json.loads(trilight(turn).output)
    one = json.loads(trilight([*words, "--seconds", "1e-9", "--json"]).output)
    assert len(found["pictures"]) == 3
    assert all(each["expected_seconds"] < one["expected_seconds"] for each in found["pictures"])
    again = json.loads(trilight(turn).output)
    assert [each["kept"] for each in again["pictures"]] == [True] * 3
    assert [each["picture_seconds"] for each in again["pictures"]] == [None] * 3


def test_the_costs_of_this_machine_choose(
    words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine on which everything takes next to nothing is given the best of all ways."""
    variant = choose_variant()  # remembered where the cache was before
    monkeypatch.setattr(
        "infra.render.preview_table.cache_folder", lambda name: Path(words[3]).parent
    )
    rows = tuple(
        PartCost(part=row.part, width=row.width, serial_s=1e-7, parallel_s=0)
        for row in shipped_table().costs.rows
    )
    keep_machine_costs(PictureCosts(machine=machine_name(variant), rows=rows))
    found = json.loads(trilight([*words, "--seconds", "1e-3", "--json"]).output)
    assert found["spp"] >= 256 and "costs as measured here" in found["choice"]


REFUSED: tuple[tuple[tuple[str, ...], str], ...] = (
    (("--seconds", "1", "--spp", "4"), "--spp is 4 beside --seconds; expected one of them"),
    (("--seconds", "1", "--error", "30"), "--seconds is 1 beside --error; expected one of"),
    (("--spp", "4", "--noise-floor", "30"), "--spp is 4 beside --noise-floor; expected one"),
    (("--error", "30", "--split"), "--error is 30 beside --split; expected one of them: a pr"),
    (("--error", "30", "--denoiser", "fast"), "--denoiser is fast; expected --spp beside it"),
    (("--seconds", "1", "--engine", "neural"), "--seconds is 1 beside --engine neural; expec"),
    (("--spp", "4", "--engine", "both"), "--engine both; expected --engine mitsuba: a"),
    (("--seconds", "nan"), "--seconds is nan; expected a number above 0, up to 1e+09 seconds"),
    (("--error", "99"), "--error is 99; expected at most"),
    (("--error", "30", "--resolution", "20"), "expected a multiple of 8"),
)


def test_what_cannot_be_chosen_is_one_line(words: list[str]) -> None:
    for asked, message in REFUSED:
        typed = words[:4] if "--resolution" in asked else words
        assert message in unwrapped(trilight([*typed, *asked], env=WIDE).output), asked
    assert not Path(words[3]).exists()


def test_a_preview_says_that_its_error_is_unknown(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.exr"
    words = ["render", str(source), "--out", str(out), "--resolution", "16", "--spp", "3"]
    printed = unwrapped(trilight(words, env=WIDE).output)
    assert "samples per pixel 3, one fast denoise noise floor unknown" in printed
    assert "--noise-floor 40 measures it and samples on to it" in printed
    assert f"Look at {out.with_suffix('.png')}; measure with {out}" in printed
    header = OpenEXR.File(io.BytesIO(out.read_bytes()), header_only=True).header()
    assert header["trilight.spp"] == 3
    assert not [name for name in header if "noise_floor" in name]
    assert json.loads(header["trilight.settings"])["denoiser"] == "fast"
    assert json.loads(trilight([*words, "--json"]).output)["spp"] == 3
    raw = trilight([*words, "--denoiser", "off"], env=WIDE).output
    assert "3, not denoised" in raw
