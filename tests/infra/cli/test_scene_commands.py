"""`trilight convert`, `passes` and `model`: what they make of files, and one line for a mistake."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from model.open import open_network
from model.weights import encode_weights
from pipeline.exchange import convert as convert_scene
from pipeline.exchange.open_scene import load_source, scene_source
from pipeline.exchange.renderformer_h5 import read_renderformer_h5
from pipeline.exchange.renderformer_json import describe_scene
from storage.dataset.shard import write_shard
from storage.records.passes.pictures import decode_passes_exr, passes_exr
from storage.records.profiles import Profile
from storage.records.sample import encode_sample
from storage.records.scene import Scene
from storage.records.scene_file import encode_scene
from tests.command_line import trilight
from tests.crash import crash
from tests.for_each import case
from tests.infra.child_here import use_processes
from tests.model.kit import awake, publishable, tiny_config
from tests.pipeline.documents.dataset_by_hand import furnished, sample, write_dataset
from tests.pipeline.exchange.strangers_stage import write_stage
from tests.scenes_by_hand import tiny_sample, tiny_scene

pytestmark = pytest.mark.usefixtures("children_here")

FORMS = ("usda", "usdc", "usdz", "json", "h5", "safetensors")
PROFILE: Profile = "lossless"


def said(*words: str | Path) -> dict[str, Any]:
    """Return what a command prints as JSON."""
    result = trilight([*map(str, words), "--json"])
    assert result.exit_code == 0, result.exception
    return dict(json.loads(result.output))


def convert(*words: str | Path) -> dict[str, Any]:
    return said("convert", *words)


def refused(*words: str | Path) -> str:
    """Return the one line that a mistake ends in."""
    return trilight([*map(str, words)]).mistake


def loaded(path: Path, key: str = "") -> Scene:
    return load_source(scene_source(f"{path}::{key}" if key else str(path))).scene


@pytest.fixture
def shard(tmp_path: Path) -> Path:
    path = tmp_path / "train-000000.tar"
    samples = {key: encode_sample(tiny_sample(key), PROFILE) for key in ("000000003", "000000005")}
    write_shard(path, samples.items())
    return path


def test_a_scene_goes_round_through_every_form(tmp_path: Path) -> None:
    """From exact to exact form the bytes stay; JSON and HDF5 keep every triangle and its light."""
    source = tmp_path / "a.safetensors"
    source.write_bytes(encode_scene(tiny_scene()))
    for form in FORMS:
        found = convert(source, tmp_path / f"b.{form}")
        assert found["triangles"] == 3
        back = loaded(tmp_path / f"b.{form}")
        if form not in ("json", "h5"):
            assert encode_scene(back) == source.read_bytes()
        want = tiny_scene()
        assert np.array_equal(back.vertex_positions[back.faces], want.vertex_positions[want.faces])
        assert np.array_equal(
            back.materials[back.material_index], want.materials[want.material_index]
        )


def test_a_sample_and_a_whole_shard(tmp_path: Path, shard: Path) -> None:
    convert(f"{shard}::000000005", tmp_path / "one.usdz")
    assert encode_scene(loaded(tmp_path / "one.usdz")) == encode_scene(tiny_scene())
    convert(shard, tmp_path / "all.usdc")
    assert loaded(tmp_path / "all.usdc", "000000003").num_triangles == 3
    found = convert(tmp_path / "all.usdc", tmp_path / "each.safetensors")
    assert [Path(path).name for path in found["files"]] == [
        "each.000000003.safetensors", "each.000000005.safetensors",
    ]  # fmt: skip
    assert encode_scene(loaded(Path(found["files"][1]))) == encode_scene(tiny_scene())


def test_hdf5_takes_the_pictures_of_a_sample_along(tmp_path: Path, shard: Path) -> None:
    """From a shard, and from HDF5; a scene without pictures has none there."""
    convert(f"{shard}::000000003", tmp_path / "a.h5")
    convert(tmp_path / "a.h5", tmp_path / "b.h5")
    for name in ("a.h5", "b.h5"):
        found = read_renderformer_h5(tmp_path / name).radiance_rgb
        assert found is not None
        assert np.array_equal(found, tiny_sample().radiance_rgb)
    convert(f"{shard}::000000003", tmp_path / "a.usdz")
    convert(tmp_path / "a.usdz", tmp_path / "c.h5")
    assert read_renderformer_h5(tmp_path / "c.h5").radiance_rgb is None


def test_a_strangers_stage_within_a_budget(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A child that is confined can read the stage and write its scene, as for a user."""
    stage = write_stage(tmp_path, sphere=True)
    for budget, message in (("0", "from 1 to"), ("20", "emitters take")):
        assert message in refused("convert", stage, tmp_path / "a.json", "--budget", budget)
    fewer = convert(stage, tmp_path / "few.safetensors", "--budget", "600")
    use_processes(monkeypatch)
    whole = convert(stage, tmp_path / "whole.safetensors")
    assert loaded(tmp_path / "whole.safetensors").environment is not None, "its DomeLight"
    assert fewer["triangles"] <= 600 < whole["triangles"]
    assert any("reduced to" in note for note in fewer["notes"])
    loaded(tmp_path / "few.safetensors").check()


MISTAKES = (
    ("absent.usda", "a.json", "no such file"),
    ("a.txt", "a.json", "cannot be read as a scene"),
    ("a.usda", "a.obj", "cannot be written as a scene"),
    ("broken.usda", "a.json", "not readable as USD"),
    ("empty.h5", "a.usda", "not a readable HDF5 file"),
    ("https://x.y/a.usda", "a.json", "only files of this machine"),
    ("meshless.json", "a.usda", "absent.obj"),
)


def test_mistakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a.txt", "empty.h5"):
        (tmp_path / name).touch()
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    (tmp_path / "broken.usda").write_text("{")
    described = describe_scene(tiny_scene(), "s").json.decode()
    (tmp_path / "meshless.json").write_text(described.replace("templates/", "absent.obj/"))
    monkeypatch.chdir(tmp_path)
    before = set(tmp_path.iterdir())
    for source, target, message in MISTAKES:
        with case(source):
            assert message in refused("convert", source, target)
        assert set(tmp_path.iterdir()) == before, source


def test_a_crash_in_native_code_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = write_stage(tmp_path)
    use_processes(monkeypatch)
    monkeypatch.setattr(convert_scene, "source_keys", crash)
    told = refused("convert", stage, tmp_path / "a.json")
    assert told.startswith("stage.usda: could not be converted (crashed_signal_11")


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    scenes = {"train-000000.tar": [0, 1], "test-000001.tar": [2]}
    shards = {name: [sample(i, furnished(["a"])) for i in rows] for name, rows in scenes.items()}
    write_dataset(tmp_path / "data", shards)
    return tmp_path / "data"


def test_passes_are_of_the_views_that_are_named(dataset: Path, tmp_path: Path) -> None:
    """Of a dataset, of one scene of it, and of the file of a scene; what is not there is named."""
    out = tmp_path / "out"
    words = ("--passes", "normal,depth", "--passes", "object", "--out", out)
    found = said("passes", dataset, *words)
    assert found["passes"] == ["object", "depth_axis_m", "shading_normal"]
    assert [Path(path).name for path in found["files"]] == [
        f"{scene:09d}.{view}.passes.exr" for scene in (2, 0, 1) for view in range(2)
    ]
    names = ("object", "depth_axis_m", "shading_normal")
    data = (out / "000000002.1.passes.exr").read_bytes()
    assert data == passes_exr(furnished(["a"]), names, view=1, resolution=16)
    one = ("--scene", "1", "--view", "1", "--resolution", "8", "--rays-a-side", "2")
    (path,) = said("passes", dataset, *one, "--out", tmp_path / "one")["files"]
    assert Path(path).name == "000000001.1.passes.exr"
    assert set(decode_passes_exr(Path(path).read_bytes(), 8)) == {
        *("object", "coverage", "depth_axis_m", "shading_normal")
    }
    file = tmp_path / "floor.safetensors"
    file.write_bytes(encode_scene(tiny_scene()))
    found = said("passes", file, "--view", "0", "--passes", "triangle", "--out", tmp_path)
    assert found["files"] == [str(tmp_path / "floor.0.passes.exr")]
    data = (tmp_path / "floor.0.passes.exr").read_bytes()
    assert data == passes_exr(tiny_scene(), ["triangle"], view=0, resolution=256)
    for option, value, message in (
        ("--scene", "9", "no scene 000000009; expected one of its 3"),
        ("--view", "2", "view is 2; expected 0 to 1"),
        ("--passes", "dept", "did you mean depth?"),
        ("--passes", "motion_px", "another moment"),
    ):
        assert message in refused("passes", dataset, option, value, "--out", tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_a_size_is_described() -> None:
    text = trilight(["model", "base"]).stdout
    for word in ("194.96 M", "692.7 GFLOP", "memory, bfloat16", "cross-attention"):
        assert word in text
    found = said("model", "large", "--views", "4", "--resolution", "512")
    assert sum(found["parameters"].values()) == 483_266_819
    assert found["workload"] == {"resolution": 512, "triangles": 1536, "views": 4}
    assert found["config"]["window_bundles"] == 8
    assert found["weight_bytes"]["bfloat16"] < 0.51 * found["weight_bytes"]["float32"]


def test_a_checkpoint_is_described_and_published(tmp_path: Path) -> None:
    model = awake(publishable("swin"), torch.float32)
    path = tmp_path / "model.safetensors"
    path.write_bytes(encode_weights(model))
    target = tmp_path / "published"
    found = said("model", path, "--publish", target, "--resolution", "64")
    assert found["config"]["window_bundles"] == 8
    again = open_network(str(target))
    for (name, a), b in zip(again.named_parameters(), model.parameters(), strict=True):
        assert torch.equal(a, b), name
    path.write_bytes(encode_weights(awake(tiny_config(), torch.float32)))
    assert "head linear" in refused("model", str(path), "--publish", str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()
