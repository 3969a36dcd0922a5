"""`trilight inspect FILE`: what one scene holds, and a sheet of it from all sides."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.exchange.usd.write import write_usd
from pipeline.making.inspect_scene import ROWS, VIEWS, turntable_poses
from storage.errors import TrilightError
from tests.command_line import trilight
from tests.scenes_by_hand import tiny_scene


def test_a_summary_and_a_sheet(tmp_path: Path) -> None:
    write_usd(tmp_path / "a.usdz", tiny_scene())
    words = ["inspect", str(tmp_path / "a.usdz"), "--turntable", str(tmp_path / "t.png"), "--json"]
    result = trilight(words)
    assert result.exit_code == 0, result.exception
    found = json.loads(result.output)
    assert found["triangles"] == 3 and found["lights"] == 1
    assert found["objects"] == "1 emitter, 1 shell"
    assert found["notes"] == []
    sheet = np.asarray(Image.open(tmp_path / "t.png"))
    assert sheet.shape[0] * VIEWS == sheet.shape[1] * ROWS**2
    tiles = np.split(sheet, ROWS)
    assert all(tile.max() > 50 for row in tiles for tile in np.split(row, VIEWS // ROWS, axis=1))


def test_every_pose_sees_all_of_the_scene() -> None:
    scene = tiny_scene()
    points = np.concatenate([scene.vertex_positions[:4], np.ones((4, 1), np.float32)], axis=1)
    for pose in turntable_poses(scene):
        local = np.einsum("ij,vj->vi", np.linalg.inv(pose), points)
        assert (np.abs(local[:, :2]) < np.tan(np.radians(20)) * -local[:, 2:3]).all()


def test_mistakes(tmp_path: Path) -> None:
    write_usd(tmp_path / "a.usda", tiny_scene())
    for words, message in (
        ([str(tmp_path / "a.usda"), "--turntable", "x.jpg"], "the name of a file X.png"),
        ([str(tmp_path), "--turntable", "x.png"], "expected one scene"),
        ([str(tmp_path / "absent.usda")], "no such file"),
    ):
        result = trilight(["inspect", *words])
        assert isinstance(result.exception, TrilightError)
        with pytest.raises(TrilightError, match=message):
            raise result.exception
