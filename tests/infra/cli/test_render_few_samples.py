"""`trilight render --spp`: a preview says what it is, and that its error is unknown."""

import io
import json
from pathlib import Path

import OpenEXR
import pytest

from storage.records.scene_file import encode_scene
from tests.command_line import trilight
from tests.scenes_by_hand import tiny_scene

pytestmark = pytest.mark.usefixtures("children_here")

WIDE = {"COLUMNS": "300"}


def unwrapped(text: str) -> str:
    return " ".join(text.split())


def test_a_preview_says_that_its_error_is_unknown(tmp_path: Path) -> None:
    source, out = tmp_path / "tiny.safetensors", tmp_path / "x.exr"
    source.write_bytes(encode_scene(tiny_scene()))
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


REFUSED: tuple[tuple[tuple[str, ...], str], ...] = (
    (("--spp", "4", "--noise-floor", "30"), "--spp is 4 beside --noise-floor; expected one"),
    (("--spp", "4", "--split"), "--spp is 4 beside --split; expected one of them"),
    (("--denoiser", "fast"), "--denoiser is fast; expected --spp beside it"),
    (("--spp", "4", "--engine", "neural"), "--engine neural; expected --engine mitsuba: a"),
    (("--spp", "4", "--engine", "both"), "--engine both; expected --engine mitsuba: a"),
    (("--spp", "0"), "--spp is 0; expected a whole number from 1 to 4096 samples"),
)


def test_a_preview_measures_nothing(tmp_path: Path) -> None:
    source = tmp_path / "tiny.safetensors"
    source.write_bytes(encode_scene(tiny_scene()))
    for words, message in REFUSED:
        asked = ["render", str(source), "--out", str(tmp_path / "x.exr"), *words]
        assert message in unwrapped(trilight(asked, env=WIDE).output), words
    assert not (tmp_path / "x.exr").exists()
