"""`trilight render` by both engines, and to many pictures: turns, stages, shards."""

import io
import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image
from pxr import Usd, UsdGeom

from model.neural_renderer import NeuralRenderer
from pipeline.exchange.renderformer_h5 import write_renderformer_h5
from pipeline.exchange.usd.write import write_usd
from storage.conventions import preview_srgb8
from storage.dataset.shard import write_shard
from storage.metrics import psnr_log_db
from storage.records.exr import decode_exr
from storage.records.sample import encode_sample
from storage.records.scene_file import encode_scene, scene_digest
from tests.command_line import trilight
from tests.infra.render.render_kit import SMALL, mistake, render, write_network
from tests.model.test_neural_renderer import many_lights
from tests.pipeline.exchange.strangers_stage import write_stage
from tests.scenes_by_hand import tiny_sample, tiny_scene
from train.evaluation.error_colors import error_picture

pytestmark = pytest.mark.usefixtures("children_here")


@pytest.fixture
def network(tmp_path: Path) -> Path:
    return write_network(tmp_path / "model.safetensors", max_triangles=2)


def neural(source: str | Path, out: Path, network: Path, *more: str) -> dict[str, object]:
    return render(source, "--out", out, "--engine", "neural", "--checkpoint", network, *more)


def test_every_form_of_a_scene_gives_the_picture_of_the_api(
    network: Path, source: Path, tmp_path: Path
) -> None:
    shard = tmp_path / "train-000000.tar"
    write_shard(shard, [("000000012", encode_sample(tiny_sample(key="000000012")))])
    write_usd(tmp_path / "tiny.usda", tiny_scene())
    write_renderformer_h5(tmp_path / "tiny.h5", tiny_scene(), texture_type="float32")
    renderer = NeuralRenderer.load(network, device="cpu")
    with pytest.warns(UserWarning, match="3 triangles"):
        expected = renderer.render(tiny_scene(), 16)[1]
    sources: list[str | Path] = [
        source,
        f"{shard}::000000012",
        tmp_path / "tiny.usda",
        tmp_path / "tiny.h5",
    ]
    for row, form in enumerate(sources):
        out = tmp_path / f"{row}.exr"
        found = neural(form, out, network, "--view", "1")
        picture = decode_exr(out.read_bytes())
        # half floats are exact to 2^-11 of their value; HDF5 orders the triangles anew
        np.testing.assert_allclose(picture, expected, rtol=1e-3, atol=1e-4)
        shown = np.asarray(Image.open(out.with_suffix(".png")))
        np.testing.assert_array_equal(shown[::16, ::16], preview_srgb8(picture))
        assert (found["engine"], found["passes"], found["triangles"]) == ("neural", 1, 3)
    assert "trained on at most 2" in str(found["notes"])


def test_the_picture_names_its_network(network: Path, source: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.exr"
    neural(source, out, network)
    first = out.read_bytes()
    header = OpenEXR.File(io.BytesIO(first), header_only=True).header()
    assert header["trilight.engine"] == "neural"
    assert header["trilight.checkpoint"] == "model.safetensors"
    assert header["trilight.network_sha256"] == NeuralRenderer.load(network).digest
    assert header["trilight.scene_sha256"] == scene_digest(tiny_scene())
    assert json.loads(header["trilight.settings"]) == {
        "lights_per_pass": 8,
        "precision": "float32",
        "resolution": 16,
        "skip_empty_bundles": False,
    }
    assert str(tmp_path) not in str(header)
    neural(source, out, network)
    assert out.read_bytes() == first


def test_both_engines_stand_side_by_side(network: Path, source: Path, tmp_path: Path) -> None:
    out, arguments = tmp_path / "x.exr", ("--engine", "both", "--checkpoint", network)
    found = render(source, "--out", out, *arguments)
    traced, drawn = (
        decode_exr((tmp_path / f"x.{name}.exr").read_bytes()) for name in ("mitsuba", "neural")
    )
    assert not out.exists()
    assert found["psnr_log_db"] == pytest.approx(psnr_log_db(drawn, traced), abs=1e-3)
    assert found["mitsuba"]["spp"] == 8
    assert found["neural"]["passes"] == 1
    sheet = np.asarray(Image.open(tmp_path / "x.png"))
    assert sheet.shape == (256 + 24, 3 * 256 + 2 * 8, 3)
    left, middle, right = (sheet[24::16, at : at + 256 : 16] for at in (0, 264, 528))
    np.testing.assert_array_equal(left, preview_srgb8(traced))
    np.testing.assert_array_equal(middle, preview_srgb8(drawn))
    np.testing.assert_array_equal(right, error_picture(drawn, traced))
    render(source, "--out", out, *arguments, "--exposure", "-2")
    darker = np.asarray(Image.open(tmp_path / "x.png"))
    np.testing.assert_array_equal(darker[24::16, :256:16], preview_srgb8(traced / 4))
    np.testing.assert_array_equal(darker[24:, 528:], sheet[24:, 528:])  # an error stays one
    words = [str(word) for word in ("render", source, "--out", out, *arguments, *SMALL)]
    printed = trilight(words).output.replace("\n", "")
    for text in ("agreement", "samples per pixel", "model.safetensors; passes: 1", "x.png"):
        assert text in printed


def test_radiance_beyond_half_floats_is_clipped_and_told(source: Path, tmp_path: Path) -> None:
    bright = write_network(tmp_path / "bright.safetensors", bias=6.0)
    found = neural(source, tmp_path / "x.exr", bright)
    assert found["clipped_pixels"] == 16 * 16
    assert "neural: pixels beyond what half floats hold were clipped" in str(found["notes"])
    assert decode_exr((tmp_path / "x.exr").read_bytes()).max() == 65504


def test_lights_are_rendered_in_groups_of_the_size_that_is_asked_for(
    network: Path, tmp_path: Path
) -> None:
    (tmp_path / "many.safetensors").write_bytes(encode_scene(many_lights(9)))
    for most, passes in (("8", 2), ("3", 3), ("9", 1)):
        found = neural(
            tmp_path / "many.safetensors", tmp_path / "x.exr", network, "--lights-per-pass", most
        )
        assert found["passes"] == passes


def test_mistakes_are_one_line(network: Path, source: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.exr"
    for words, message in (
        (("--checkpoint", network), "expected --engine neural or both beside it"),
        (
            ("--engine", "neural", "--checkpoint", tmp_path / "no"),
            f"checkpoint {tmp_path / 'no'}: no such file",
        ),
        (("--engine", "neural", "--checkpoint", source), str(tmp_path)),
        (
            ("--engine", "neural", "--checkpoint", network, "--precision", "half"),
            "--precision is 'half'; expected one of float32",
        ),
        (("--engine", "both", "--checkpoint", network, "--view", "2"), "--view is 2"),
    ):
        assert message in mistake(source, "--out", out, *words)
    assert not out.exists()
    assert "only files of this machine" in mistake("https://h/{0..1}.h5", "--out", tmp_path / "all")
    bad = mistake(source, "--out", tmp_path / "all", "--cameras", tmp_path / "none.json")
    assert "none.json: no such file" in bad
    assert "--view is 9" in mistake(
        source, "--out", tmp_path / "all", "--orbit", "2", "--view", "9"
    )


def test_a_turn_is_path_traced_to_a_video_and_kept(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "turn.webp"
    words = (source, "--out", out, "--orbit", "3", "--fps", "10")
    found = render(*words)
    assert found["video"] == str(out)
    assert [picture["kept"] for picture in found["pictures"]] == [False] * 3
    exrs = [Path(picture["exr"]) for picture in found["pictures"]]
    assert [path.name for path in exrs] == ["000000.exr", "000001.exr", "000002.exr"]
    pictures = [decode_exr(path.read_bytes()) for path in exrs]
    assert min(picture.mean() for picture in pictures) > 0.01
    assert (pictures[0] != pictures[1]).any()
    with Image.open(out) as video:
        assert (getattr(video, "n_frames", 1), video.size) == (3, (256, 256))
    exrs[1].unlink()
    again = render(*words)
    assert [picture["kept"] for picture in again["pictures"]] == [True, False, True]
    np.testing.assert_array_equal(decode_exr(exrs[1].read_bytes()), pictures[1])


def test_a_stage_that_moves_is_drawn_frame_by_frame_by_both_engines(tmp_path: Path) -> None:
    path, network = write_stage(tmp_path), write_network(tmp_path / "model.safetensors")
    stage = Usd.Stage.Open(str(path))
    move = UsdGeom.Xformable(stage.GetPrimAtPath("/W/Grid")).AddTranslateOp()
    for frame, height in ((1, 0), (3, 20)):
        move.Set((0, height, 0), frame)
    stage.SetStartTimeCode(1)
    stage.SetEndTimeCode(3)
    stage.GetRootLayer().Save()
    out = tmp_path / "both"
    found = render(path, "--out", out, "--engine", "both", "--checkpoint", network)
    assert found["video"] is None
    assert len({picture["scene_sha256"] for picture in found["pictures"]}) == 3
    assert all(0 < picture["psnr_log_db"] < 100 for picture in found["pictures"])
    # by hand from the files: what of the error is another in the next frame
    errors = [
        np.log10(1 + decode_exr((out / f"{at:06d}.neural.exr").read_bytes()))
        - np.log10(1 + decode_exr((out / f"{at:06d}.mitsuba.exr").read_bytes()))
        for at in range(3)
    ]
    changes = [np.mean((errors[at + 1] - errors[at]) ** 2) for at in range(2)]
    flicker = [picture.get("flicker") for picture in found["pictures"]]
    assert flicker[0] is None
    for at in range(2):
        # files hold half floats of radiance: 5e-4 of a value, 0.01 dB of an error above 0.1
        assert flicker[at + 1]["db"] == pytest.approx(-10 * np.log10(changes[at]), abs=0.05)
        assert flicker[at + 1]["noise_db"] > 0
    names = sorted(path.name for path in out.iterdir())
    suffixes = ("mitsuba.exr", "neural.exr", "png")
    assert names == [f"{at:06d}.{suffix}" for at in range(3) for suffix in suffixes]
    words = ["render", path, "--out", out, "--engine", "both", "--checkpoint", network, *SMALL]
    printed = trilight([str(word) for word in words]).output
    assert "6, of which 6 were there already" in printed
    assert "agreement" in printed and "flicker" in printed
