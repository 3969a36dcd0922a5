"""`trilight inspect FILE`: what one scene holds, and a sheet of it from all sides."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.exchange.usd.write import write_usd
from pipeline.making import inspect_scene as inspecting
from pipeline.making.inspect_scene import ROWS, VIEWS, seen_into, turntable_poses
from storage.conventions import look_at_c2w
from storage.errors import TrilightError
from storage.records.scene import ObjectKind, SceneObject
from tests.command_line import trilight
from tests.infra.child_here import use_children_here
from tests.scenes_by_hand import tiny_scene

KINDS: tuple[tuple[str, ObjectKind], ...] = (
    ("floor", "shell"),
    ("walls", "shell"),
    ("thing", "object"),
)


def test_a_summary_and_a_sheet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use_children_here(monkeypatch)
    monkeypatch.setattr(inspecting, "_RESOLUTION", 32)
    monkeypatch.setattr(inspecting, "_SPP", 16)
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


def test_walls_before_the_objects_are_left_out() -> None:
    floor, wall, thing = (SceneObject(name=name, kind=kind) for name, kind in KINDS)
    walls = [[[x, -1, 0], [x, 1, 0], [x, 0, 1]] for x in (1, -1)]
    corners = [*walls, [[0, 0, 0.1], [0.1, 0, 0.1], [0, 0.1, 0.3]], [[1, 0, 0], [0, 1, 0], [0] * 3]]
    room = tiny_scene(
        vertex_positions=np.array(corners, np.float32).reshape(-1, 3),
        vertex_normals=np.tile(np.array([0, 0, 1], np.float32), (12, 1)),
        faces=np.arange(12, dtype=np.uint32).reshape(4, 3),
        material_index=np.zeros(4, np.uint16),
        object_index=np.array([1, 1, 2, 0], np.uint16),
        objects=(floor, wall, thing),
    )
    for x, kept in ((5, [1, 2, 3]), (-5, [0, 2, 3]), (0.5, [0, 1, 2, 3])):
        pose = look_at_c2w(eye=[x, 0.2, 0.5], target=[0, 0, 0], up=[0, 0, 1])
        shown = seen_into(room, pose.astype(np.float32))
        assert shown.faces[:, 0].tolist() == [3 * row for row in kept]
        assert shown.object_index.tolist() == room.object_index[kept].tolist()
    floor_only = tiny_scene()
    assert seen_into(floor_only, floor_only.c2w[0]) is floor_only
