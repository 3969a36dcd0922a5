"""`trilight render` to many pictures: turns, moving stages, shards, and calls that go on."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pxr import Usd, UsdGeom

from storage.dataset.shard import write_shard
from storage.records.exr import decode_exr
from storage.records.sample import encode_sample
from storage.records.scene_file import encode_scene
from tests.command_line import trilight
from tests.infra.rendering.render_kit import SMALL, mistake, render, write_network
from tests.pipeline.exchange.strangers_stage import write_stage
from tests.scenes_by_hand import tiny_sample, tiny_scene

pytestmark = pytest.mark.usefixtures("children_here")


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    (tmp_path / "tiny.safetensors").write_bytes(encode_scene(tiny_scene()))
    return tmp_path / "tiny.safetensors"


def test_a_turn_is_path_traced_to_a_video_and_kept(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "turn.webp"
    words = (scene, "--out", out, "--orbit", "3", "--fps", "10")
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


def test_a_shard_is_a_row_of_scenes_each_from_its_camera(tmp_path: Path) -> None:
    shard, network = tmp_path / "train-000000.tar", write_network(tmp_path / "model.safetensors")
    keys = ["000000003", "000000007"]
    write_shard(shard, [(key, encode_sample(tiny_sample(key=key))) for key in keys])
    arguments = ("--engine", "neural", "--checkpoint", network, "--view", "1")
    found = render(shard, "--out", tmp_path / "all", *arguments)
    assert len(found["pictures"]) == 2
    alone = render(f"{shard}::{keys[1]}", "--out", tmp_path / "one.exr", *arguments)
    assert alone["scene_sha256"] == found["pictures"][1]["scene_sha256"]
    one, second = (tmp_path / name for name in ("one.exr", "all/000001.exr"))
    np.testing.assert_array_equal(decode_exr(one.read_bytes()), decode_exr(second.read_bytes()))


def test_mistakes_are_one_line(scene: Path, tmp_path: Path) -> None:
    assert "no such file" in mistake(tmp_path / "none", "--out", tmp_path / "all")
    assert "only files of this machine" in mistake("https://h/{0..1}.h5", "--out", tmp_path / "all")
    bad = mistake(scene, "--out", tmp_path / "all", "--cameras", tmp_path / "none.json")
    assert "none.json: no such file" in bad
    assert "--view is 9" in mistake(scene, "--out", tmp_path / "all", "--orbit", "2", "--view", "9")
