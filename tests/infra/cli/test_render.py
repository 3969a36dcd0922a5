"""`trilight render`: pictures of every kind of source by both engines, previews, and refusals."""

import io
import itertools
import json
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from PIL import Image
from pxr import Usd, UsdGeom

from infra.render import path_tracer
from infra.render.plan import RenderOptions
from infra.render.preview_table import shipped_table
from model.inference import NeuralRenderer
from pipeline.exchange.convert import write_scene
from pipeline.exchange.reader import SceneReader, load_source, scene_source
from pipeline.exchange.renderformer_h5 import write_renderformer_h5
from pipeline.exchange.usd.write_usd import write_usd
from storage.conventions import preview_srgb8
from storage.dataset.shard import write_shard
from storage.errors import TrilightError
from storage.metrics import psnr_log_db
from storage.records.exr import decode_exr
from storage.records.lights import sum_of_parts
from storage.records.profiles import Profile
from storage.records.sample import Sample, encode_sample
from storage.records.scene import Scene
from storage.records.scene_file import encode_scene, scene_digest
from storage.settings.overrides import option_words
from tests.command_line import expect_json, expect_mistake, expect_output
from tests.crash import CrashingRenderer
from tests.for_each import case
from tests.infra.child_here import use_processes
from tests.infra.conftest import write_network
from tests.model.test_inference import many_lights
from tests.pipeline.exchange.exchange_kit import write_stage
from tests.scenes_by_hand import tiny_sample, tiny_scene
from train.evaluation.sheet import error_picture

pytestmark = pytest.mark.usefixtures("children_here")

FEW = ("--resolution", "16", "--max-spp", "8")
SMALL = (*FEW, "--noise-floor", "90")


def printed(*words: str | Path) -> str:
    """Return what a render says, in one line: long paths break it even on a wide screen."""
    return " ".join(expect_output("render", *words, COLUMNS="400").split())


def render(*words: str | Path) -> dict[str, Any]:
    """Return what `trilight render --json` prints of a small picture."""
    return expect_json("render", *words, *SMALL)


def header(path: Path) -> dict[str, Any]:
    """Return the header of a picture without the prefix of its names."""
    stored = OpenEXR.File(io.BytesIO(path.read_bytes()), header_only=True).header()
    return {name.removeprefix("trilight."): value for name, value in stored.items()}


def shown(path: Path) -> np.ndarray:
    """Return the pixels of a PNG."""
    return np.asarray(Image.open(path))


@pytest.fixture
def network(tmp_path: Path) -> Path:
    return write_network(tmp_path / "model.safetensors", max_triangles=2)


@pytest.fixture
def described(tmp_path: Path) -> Path:
    """The tiny scene as a file of RenderFormer, with a field that is unknown."""
    path = tmp_path / "scenes" / "two.json"
    path.parent.mkdir()
    write_scene(path, tiny_scene())
    record = json.loads(path.read_text())
    record["objects"]["floor"]["colour"] = "red"
    path.write_text(json.dumps(record))
    return path


def _shard(path: Path, scene: Scene, profile: Profile = "lossless") -> Path:
    made = tiny_sample(key="000000012")
    sample = Sample(key=made.key, scene=scene, radiance_rgb=made.radiance_rgb, views=made.views)
    other = tiny_sample(key="000000011")
    write_shard(path, [(each.key, encode_sample(each, profile)) for each in (other, sample)])
    return path


def test_every_form_of_a_scene_gives_one_picture_by_both_engines(
    described: Path, network: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last one in child processes, as for a user; the others here."""
    scene = load_source(scene_source(str(described))).scene
    (tmp_path / "two.safetensors").write_bytes(encode_scene(scene))
    write_usd(tmp_path / "two.usda", scene)
    shard = _shard(tmp_path / "train-000000.tar", scene)
    packed = _shard(tmp_path / "train-000001.tar", scene, "compact")
    forms: list[str | Path] = ["two.usda", described, "two.safetensors", f"{shard}::000000012"]
    forms.append(f"{packed}::000000012")
    with pytest.warns(UserWarning, match="3 triangles"):
        expected = NeuralRenderer.load(network, device="cpu").render(scene, 16)[1]
    traced: list[np.ndarray] = []
    for row, form in enumerate(forms):
        if form == forms[-1]:
            use_processes(monkeypatch)
        out = tmp_path / f"new/{row}.exr"
        engines = ("--engine", "both", "--checkpoint", network, "--view", "1")
        with case(form):
            found = render(tmp_path / form, "--out", out, *engines)
            of_network = decode_exr(out.with_suffix(".neural.exr").read_bytes())
            # half floats are exact to 2^-11 of their value
            np.testing.assert_allclose(of_network, expected, rtol=1e-3, atol=1e-4)
            assert (found["triangles"], found["lights"], found["neural"]["passes"]) == (3, 1, 1)
            assert "trained on at most 2" in str(found["notes"])
            assert "may flatter" in str(found["notes"])
            assert ("unknown field objects.floor.colour" in found["notes"][0]) == (row == 1)
            traced.append(decode_exr(out.with_suffix(".mitsuba.exr").read_bytes()))
            np.testing.assert_array_equal(traced[-1], traced[0])
            assert found["scene_sha256"] == scene_digest(scene)
            facts = found["mitsuba"]
            assert (facts["spp"], found["view"], facts["at_cap"]) == (8, 1, True)
            mean = traced[0].mean(dtype=np.float64)
            assert facts["mean_radiance"] == pytest.approx(mean, rel=1e-3)
    assert traced[0].shape == (16, 16, 3) and traced[0].mean() > 0.01


def test_pictures_by_both_engines_say_how_they_were_made_and_stand_side_by_side(
    source: Path, network: Path, tmp_path: Path
) -> None:
    out = tmp_path / "x.exr"
    both = ("--engine", "both", "--checkpoint", network, "--seed", str(1 << 40))
    outcome = render(source, "--out", out, *both)
    files = {name: tmp_path / f"x.{name}.exr" for name in ("mitsuba", "neural")}
    traced, drawn = (header(path) for path in files.values())
    for found in (traced, drawn):
        assert found["scene_sha256"] == scene_digest(tiny_scene())
        assert str(tmp_path) not in str(found)
    assert traced["source"] == "tiny.safetensors"
    assert (traced["seed"], traced["spp"]) == (str(1 << 40), 8)
    floor_db = outcome["mitsuba"]["noise_floor_db"]
    assert traced["noise_floor_db"] == pytest.approx(floor_db, rel=1e-6), "a float32 in a header"
    # no target that was not asked for: pictures made before there were others are kept
    assert set(json.loads(traced["settings"])) == {
        "resolution", "noise_floor_db", "min_spp", "max_spp", "reject_at_cap", "max_depth",
        "rr_depth", "aux_spp", "denoiser", "min_mean_radiance", "per_light", "arithmetic",
        "stated_error", "min_spp_px", "picture_within_db",
    }  # fmt: skip
    assert "mitsuba_variant" in json.loads(traced["environment"])
    assert (drawn["engine"], drawn["checkpoint"]) == ("neural", "model.safetensors")
    assert drawn["network_sha256"] == NeuralRenderer.load(network).digest
    assert json.loads(drawn["settings"]) == {
        "lights_per_pass": 8, "precision": "float32", "resolution": 16, "skip_empty_bundles": False
    }  # fmt: skip
    first = {name: path.read_bytes() for name, path in files.items()}
    render(source, "--out", out, *both)
    assert {name: path.read_bytes() for name, path in files.items()} == first
    by_path, by_network = (decode_exr(data) for data in first.values())
    assert not out.exists()
    assert outcome["psnr_log_db"] == pytest.approx(psnr_log_db(by_network, by_path), abs=1e-3)
    sheet = shown(tmp_path / "x.png")
    assert sheet.shape == (256 + 24, 3 * 256 + 2 * 8, 3)
    left, middle, right = (sheet[24::16, at : at + 256 : 16] for at in (0, 264, 528))
    np.testing.assert_array_equal(left, preview_srgb8(by_path))
    np.testing.assert_array_equal(middle, preview_srgb8(by_network))
    np.testing.assert_array_equal(right, error_picture(by_network, by_path))
    said = printed(source, "--out", out, *both, *SMALL, "--exposure", "-2")
    darker = shown(tmp_path / "x.png")
    np.testing.assert_array_equal(darker[24::16, :256:16], preview_srgb8(by_path / 4))
    np.testing.assert_array_equal(darker[24:, 528:], sheet[24:, 528:])  # an error stays one
    for text in ("agreement", "samples per pixel", "model.safetensors; passes: 1", "x.png"):
        assert text in said


def test_a_network_clips_what_half_floats_lack_and_groups_lights(
    source: Path, network: Path, tmp_path: Path
) -> None:
    out = tmp_path / "x.exr"
    bright = write_network(tmp_path / "bright.safetensors", bias=6.0)
    found = render(source, "--out", out, "--engine", "neural", "--checkpoint", bright)
    assert found["clipped_pixels"] == 16 * 16
    assert "neural: pixels beyond what half floats hold were clipped" in str(found["notes"])
    assert decode_exr(out.read_bytes()).max() == 65504
    source.write_bytes(encode_scene(many_lights(9)))
    drawn = (source, "--out", out, "--engine", "neural", "--checkpoint", network)
    for most, passes in (("8", 2), ("3", 3), ("9", 1)):
        assert render(*drawn, "--lights-per-pass", most)["passes"] == passes
    np.testing.assert_array_equal(
        shown(out.with_suffix(".png"))[::16, ::16], preview_srgb8(decode_exr(out.read_bytes()))
    )
    write_renderformer_h5(tmp_path / "many.h5", many_lights(9))
    first = decode_exr(out.read_bytes())
    render(tmp_path / "many.h5", *drawn[1:], "--lights-per-pass", "9")
    # it orders the triangles anew, and half floats are exact to 2^-11 of their value
    np.testing.assert_allclose(decode_exr(out.read_bytes()), first, rtol=2e-3, atol=2e-4)


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
    assert [picture["kept"] for picture in render(*words)["pictures"]] == [True, False, True]
    np.testing.assert_array_equal(decode_exr(exrs[1].read_bytes()), pictures[1])
    said = printed(*words, *SMALL)
    floors = r"stated error +median -?\d+\.\d dB, 5th percentile -?\d+\.\d dB \(psnr_log_db\)"
    assert len(re.findall(floors, said)) == said.count("percentile") == 1


def test_a_stage_that_moves_is_drawn_frame_by_frame_by_both_engines(
    network: Path, tmp_path: Path
) -> None:
    path = write_stage(tmp_path)
    stage = Usd.Stage.Open(str(path))
    move = UsdGeom.Xformable(stage.GetPrimAtPath("/W/Grid")).AddTranslateOp()
    for frame, height in ((1, 0), (3, 20)):
        move.Set((0, height, 0), frame)
    stage.SetStartTimeCode(1)
    stage.SetEndTimeCode(3)
    stage.GetRootLayer().Save()
    out = tmp_path / "both"
    words = (path, "--out", out, "--engine", "both", "--checkpoint", network)
    found = render(*words)
    assert found["video"] is None
    assert len({picture["scene_sha256"] for picture in found["pictures"]}) == 3
    assert all(0 < picture["psnr_log_db"] < 100 for picture in found["pictures"])
    # by hand from the files: what of the error is another in the next frame
    light = {
        name: [
            np.log10(1 + decode_exr((out / f"{at:06d}.{name}.exr").read_bytes()))
            for at in (0, 1, 2)
        ]
        for name in ("neural", "mitsuba")
    }
    errors = np.subtract(light["neural"], light["mitsuba"])
    changes = [np.mean((errors[at + 1] - errors[at]) ** 2) for at in range(2)]
    flicker = [picture.get("flicker") for picture in found["pictures"]]
    assert flicker[0] is None
    for at in range(2):
        # files hold half floats of radiance: 5e-4 of a value, 0.01 dB of an error above 0.1
        assert flicker[at + 1]["db"] == pytest.approx(-10 * np.log10(changes[at]), abs=0.05)
        assert flicker[at + 1]["noise_db"] > 0
    suffixes = ("mitsuba.exr", "neural.exr", "png")
    names = [f"{at:06d}.{suffix}" for at in range(3) for suffix in suffixes]
    assert sorted(path.name for path in out.iterdir()) == names
    said = printed(*words, *SMALL)
    for text in ("6, of which 6 were there already", "agreement", "flicker"):
        assert text in said


def test_a_target_governs_and_its_floor_and_what_is_probable_are_said(
    source: Path, tmp_path: Path
) -> None:
    out = tmp_path / "x.exr"
    words = (source, "--out", out, "--resolution", "16", "--noise-floor-linear", "5")
    said = printed(*words, "--max-spp", "64")
    assert "(psnr_linear_db: linear, clamped to [0, 1]; reached 5 dB)" in said
    assert "psnr_log_db" not in said
    settings = json.loads(header(out)["settings"])
    assert (settings["noise_floor_db"], settings["noise_floor_linear_db"]) == (None, 5)
    both = printed(*words, "--noise-floor-objects", "95", "--max-spp", "8")
    assert "clamped to [0, 1]; reached 5 dB)" in both
    assert "geometry is seen; the cap came before 95 dB)" in both
    # at a width that is calibrated; elsewhere the bound is named
    words = (source, "--out", out, "--noise-floor", "5", "--max-spp", "128")
    assert "probably" not in printed(*words, "--resolution", "64", "--stated-error", "bound")
    said = printed(*words, "--resolution", "64")
    assert re.search(r"stated error +-?\d+\.\d dB, probably -?\d+\.\d \(psnr_log_db; ", said)
    assert re.search(r"hundred pictures .* \d\d or more are at most 1 dB worse, and half are", said)
    assert header(out)["expected_error_db"] > header(out)["noise_floor_db"]
    said = printed(*words, "--resolution", "256")
    assert header(out)["spp"] == 32 and "may flatter" not in said, "calibrated from 32 samples on"
    said = printed(*words, "--resolution", "16")
    assert "a bound: pictures like this one are not calibrated" in said


def test_the_words_of_what_was_asked_give_the_picture_again(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.exr"
    asked = RenderOptions(
        source=str(source), out=out, resolution=16, max_spp=256, noise_floor_linear_db=22.5,
        noise_floor_objects_db=20.25,
    )  # fmt: skip
    typed = ["--noise-floor-linear", "22.5", "--noise-floor-objects", "20.25", "--max-spp", "256"]
    typed += ["--resolution", "16", "--out", str(out)]
    pictures = []
    for words in (typed, option_words(asked, leave_out=("source",))):
        printed(source, *words)
        pictures.append(out.read_bytes())
    assert pictures[0] == pictures[1]


def test_parts_stand_as_layers_in_the_file_of_the_picture(source: Path, tmp_path: Path) -> None:
    """With their floors in its header; a film's files with layers are kept like others."""
    out = tmp_path / "x.exr"
    assert "layer indirect" in printed(source, "--out", out, "--split", *SMALL)
    file = OpenEXR.File(io.BytesIO(out.read_bytes()))
    assert set(file.channels()) == {"RGB", "direct", "indirect"}
    layers = {name: file.channels()[name].pixels.astype(np.float32) for name in file.channels()}
    picture = layers.pop("RGB")
    assert picture.mean() > 0.01
    np.testing.assert_array_equal(sum_of_parts(layers), picture)
    assert header(out)["indirect.noise_floor_db"] == 100.0  # a lone floor
    film = ("--orbit", "1", "--out", tmp_path / "film", "--split", "--split-lobes")
    for kept in (False, True):
        (shot,) = render(source, *film)["pictures"]
        assert shot["kept"] is kept
        assert shot["diffuse_indirect.noise_floor_db"] == 100.0


def test_a_preview_says_that_its_error_is_unknown_and_what_is_chosen_is_recorded(
    source: Path, tmp_path: Path
) -> None:
    out = tmp_path / "x.exr"
    words = (source, "--out", out, "--resolution", "16", "--spp", "3")
    said = printed(*words)
    assert "samples per pixel 3, one fast denoise stated error unknown" in said
    assert "--noise-floor 40 measures it and samples on to it" in said
    assert f"Look at {out.with_suffix('.png')}; measure with {out}" in said
    found = header(out)
    assert found["spp"] == 3 and json.loads(found["settings"])["denoiser"] == "fast"
    assert not [name for name in found if "noise_floor" in name]
    assert expect_json("render", *words)["spp"] == 3
    assert "3, not denoised" in printed(*words, "--denoiser", "off")
    asked = (source, "--out", out, "--resolution", "32")
    said = printed(*asked, "--error", "20")
    assert "--error 20: chosen: " in said and "a pixel, filter fast; expected" in said
    assert f"dB in the median of {shipped_table().scenes} scenes" in said
    assert "stated error unknown: a preview measures none" in said
    assert "s after start-up; expected" in said
    recorded = header(out)
    assert recorded["chosen_for"] == "--error 20"
    assert recorded["expected_db"] >= 20 and recorded["expected_seconds"] > 0
    assert json.loads(recorded["settings"])["spp"] == recorded["spp"]
    for option, value in (("--seconds", "1e-9"), ("--seconds", "0.05"), ("--error", "0")):
        with case(f"{option} {value}"):
            found = expect_json("render", *asked, option, value)
            assert found["chosen_for"] == f"{option} {value}".replace("1e-9", "1e-09")
            assert found["choice"].startswith(found["chosen_for"])
            assert ("nothing is as quick" in found["choice"]) == (value == "1e-9")
            assert found["picture_seconds"] > 0 and found["expected_seconds"] > 0
            assert "noise_floor_db" not in found
    orbit = (source, "--out", tmp_path / "turn", "--orbit", "2", *asked[3:], "--seconds", "1e-9")
    for kept in (False, True):
        for picture in expect_json("render", *orbit)["pictures"]:
            assert (picture["kept"], picture["picture_seconds"] is None) == (kept, kept)


REFUSED = {
    "--engine cycles": "--engine is 'cycles'; expected one of mitsuba, neural, both",
    "--orbit 3": "expected a folder, X.mp4 or X.webp",
    "--orbit 3 --cameras a.json": "expected no --orbit beside it",
    "--resolution 20": "resolution is 20; expected a multiple of 8",
    "--max-spp 100": "max_spp 100; expected multiples of 8",
    "--threads 0": "--threads is 0",
    "--split --engine neural": "a network makes all light together",
    "--checkpoint model.safetensors": "expected --engine neural or both beside it",
    "--engine neural --checkpoint no": "checkpoint no: no such file",
    "--engine neural --checkpoint tiny.safetensors": "weights that carry no configuration of ours",
    "--engine neural --precision half": "--precision is 'half'; expected one of float32",
    "--seconds 1 --spp 4": "--spp is 4 beside --seconds; expected one of them",
    "--seconds 1 --denoiser fast": "--denoiser is fast; expected --spp beside it",
    "--spp 4 --noise-floor 30": "--spp is 4 beside --noise-floor; expected one",
    "--spp 4 --engine both": "--engine both; expected --engine mitsuba: a",
    "--error 99": "--error is 99; expected at most",
    "--out x.png": "--out is",
    "--out /dev/null/x.exr": "/dev/null is a file; expected a folder: choose another place",
    "--out all --cameras none.json": "none.json: no such file",
    "--out all --orbit 2 --view 9": "--view is 9",
    "https://h/{0..1}.h5 --out all": "only files of this machine",
    # what only the child finds out
    "--view 2 --noise-floor 90": "--view is 2; expected 0 to 1",
    "--view 2 --engine both --checkpoint model.safetensors": "--view is 2",
    "blinding.safetensors --max-spp 8": "view 0 cannot be rendered (radiance_overflow",
}
"""Words after the source tiny.safetensors and --out x.exr, unless they name others."""


def test_refusals_are_one_line(
    network: Path, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    materials = tiny_scene().materials.copy()
    materials[1, 7:] = 3e38
    Path("blinding.safetensors").write_bytes(encode_scene(tiny_scene(materials=materials)))
    for line, message in REFUSED.items():
        words = shlex.split(line)
        of = [] if not words[0].startswith("--") else [source.name]
        to = [] if "--out" in words else ["--out", "x.exr"]
        wide = [] if "--resolution" in words else ["--resolution", "32"]
        with case(line):
            assert message in expect_mistake("render", *of, *words, *to, *wide)
    assert not Path("x.exr").exists()


def test_a_bad_source_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("set").mkdir()
    Path("text.safetensors").write_text("no scene")
    _shard(tmp_path / "train-000000.tar", tiny_scene())
    for source, message in {
        "absent.json": "no such file",
        "https://me:secret@host/a.json": "https://host/a.json: only files of this",
        "simplecache::https://host/a.tar::0": "only files of this machine",
        "absent.tar::../x": "no shard and key",
        "set": "a folder; expected a scene",
        "text.safetensors": "text.safetensors: safetensors: the header claims",
        "train-000000.tar": "expected .*train-000000.tar::KEY",
        "train-000000.tar::000000013": "no sample 000000013; expected one of its 2: 0000000",
    }.items():
        with case(source), pytest.raises(TrilightError, match=message) as caught:
            load_source(scene_source(source))
        assert "\n" not in str(caught.value), source
        assert "secret" not in str(caught.value), source
    Path("set/x.usda").write_text('def "A" {')
    with SceneReader() as reader, pytest.raises(TrilightError, match=r"^set/x\.usda: not readable"):
        reader.load(scene_source("set/x.usda"))


def test_no_engine_takes_a_vertex_beyond_the_farthest_position(
    described: Path, tmp_path: Path
) -> None:
    """Triangles that reach so far vanish from traced pictures, and rotary angles lose digits."""
    far = json.loads(described.read_text())
    far["objects"]["floor"]["transform"]["scale"] = [1e6, 1, 1]
    described.write_text(json.dumps(far))
    positions = tiny_scene().vertex_positions.copy()
    positions[0, 0] = 1e38
    shard = _shard(tmp_path / "train-000000.tar", tiny_scene(vertex_positions=positions))
    sources: tuple[str | Path, ...] = (described, f"{shard}::000000012")
    for engine, source in itertools.product(("mitsuba", "neural"), sources):
        told = expect_mistake(
            "render", source, "--engine", engine, "--out", tmp_path / "x.exr", *SMALL
        )
        assert "vertex_positions[0, 0] is " in told and "expected from -10000 to 10000 m" in told
    assert not (tmp_path / "x.exr").exists()


def test_a_crash_in_native_code_is_one_line(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a real child, which loads no renderer to be quick."""
    use_processes(monkeypatch)
    monkeypatch.setattr(path_tracer, "RenderWorker", CrashingRenderer)
    told = expect_mistake("render", source, "--out", tmp_path / "x.exr", *SMALL)
    assert told.startswith("tiny.safetensors: rendering failed (crashed_signal_11")
