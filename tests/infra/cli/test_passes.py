"""`trilight passes`: of a dataset that stores none, of scenes, and one line for mistakes."""

import json
from pathlib import Path
from typing import Any

import pytest

from storage.errors import TrilightError
from storage.records.passes.stored import decode_passes_exr, passes_exr
from storage.records.scene_file import encode_scene
from tests.command_line import trilight
from tests.pipeline.documents.dataset_by_hand import furnished, sample, write_dataset
from tests.scenes_by_hand import tiny_scene


def run(*words: str | Path) -> dict[str, Any]:
    result = trilight(["passes", *map(str, words), "--json"])
    assert result.exit_code == 0, result.exception
    return dict(json.loads(result.output))


def refused(*words: str | Path) -> str:
    result = trilight(["passes", *map(str, words)])
    assert isinstance(result.exception, TrilightError), result.exception
    assert "\n" not in str(result.exception)
    return str(result.exception)


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    scenes = {"train-000000.tar": [0, 1], "test-000001.tar": [2]}
    shards = {name: [sample(i, furnished(["a"])) for i in rows] for name, rows in scenes.items()}
    write_dataset(tmp_path / "data", shards)
    return tmp_path / "data"


def test_the_views_of_a_dataset(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    found = run(dataset, "--passes", "normal,depth", "--passes", "object", "--out", out)
    assert found["passes"] == ["object", "depth_axis_m", "shading_normal"]
    assert [Path(path).name for path in found["files"]] == [
        f"{scene:09d}.{view}.passes.exr" for scene in (2, 0, 1) for view in range(2)
    ]
    names = ("object", "depth_axis_m", "shading_normal")
    data = (out / "000000002.1.passes.exr").read_bytes()
    assert data == passes_exr(furnished(["a"]), names, view=1, resolution=16)


def test_one_view_of_one_scene(dataset: Path, tmp_path: Path) -> None:
    words = (dataset, "--scene", "1", "--view", "1", "--resolution", "8", "--rays-a-side", "2")
    (path,) = run(*words, "--out", tmp_path / "out")["files"]
    assert Path(path).name == "000000001.1.passes.exr"
    assert set(decode_passes_exr(Path(path).read_bytes(), 8)) == {
        *("object", "coverage", "depth_axis_m", "shading_normal")
    }


def test_the_file_of_a_scene(tmp_path: Path) -> None:
    path = tmp_path / "floor.safetensors"
    path.write_bytes(encode_scene(tiny_scene()))
    found = run(path, "--view", "0", "--passes", "triangle", "--out", tmp_path)
    assert found["files"] == [str(tmp_path / "floor.0.passes.exr")]
    data = (tmp_path / "floor.0.passes.exr").read_bytes()
    assert data == passes_exr(tiny_scene(), ["triangle"], view=0, resolution=256)


def test_mistakes(dataset: Path, tmp_path: Path) -> None:
    out = ("--out", tmp_path / "out")
    assert "no scene 000000009; expected one of its 3" in refused(dataset, "--scene", "9", *out)
    assert "view is 2; expected 0 to 1" in refused(dataset, "--view", "2", *out)
    assert "did you mean depth?" in refused(dataset, "--passes", "dept", *out)
    assert "another moment" in refused(dataset, "--passes", "motion_px", *out)
    assert not (tmp_path / "out").exists()
