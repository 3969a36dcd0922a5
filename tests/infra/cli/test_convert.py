"""`trilight convert`: every form to every form, shards, budgets, and one line for a mistake."""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from pipeline.exchange import convert as convert_scene
from pipeline.exchange.open_scene import load_source, scene_source
from pipeline.exchange.renderformer_h5 import read_renderformer_h5, write_renderformer_h5
from pipeline.exchange.renderformer_json import described_files
from storage.dataset.shard import write_shard
from storage.errors import TrilightError
from storage.records.profiles import Profile
from storage.records.sample import encode_sample
from storage.records.scene import Scene
from storage.records.scene_file import encode_scene
from tests.command_line import trilight
from tests.crash import crash
from tests.for_each import case
from tests.infra.child_here import use_processes
from tests.pipeline.exchange.strangers_stage import write_stage
from tests.scenes_by_hand import tiny_sample, tiny_scene

pytestmark = pytest.mark.usefixtures("children_here")

FORMS = ("usda", "usdc", "usdz", "json", "h5", "safetensors")
PROFILE: Profile = "lossless"


def convert(*arguments: str | Path) -> dict[str, Any]:
    """Return what `trilight convert --json` prints."""
    words = ["convert", *(str(argument) for argument in arguments), "--json"]
    result = trilight(words)
    assert result.exit_code == 0, result.exception
    return dict(json.loads(result.output))


def refused(*arguments: str | Path) -> str:
    """Return the one line that a mistake ends in."""
    words = ["convert", *(str(argument) for argument in arguments)]
    result = trilight(words)
    assert isinstance(result.exception, TrilightError), result.exception
    assert "\n" not in str(result.exception)
    return str(result.exception)


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
    ("a.usda", "a.usd", "cannot be written as a scene"),
    ("broken.usda", "a.json", "not readable as USD"),
    ("broken.json", "a.usda", "not readable as JSON"),
    ("empty.h5", "a.usda", "not a readable HDF5 file"),
    ("https://x.y/a.usda", "a.json", "only files of this machine"),
    ("circle.usda", "a.json", "in a circle"),
    ("outside.usda", "a.json", "outside of its folder"),
    ("meshless.json", "a.usda", "absent.obj"),
    ("nan.json", "a.usda", "NaN is no JSON number"),
    ("shapes.h5", "a.usda", "has shape"),
)


def test_mistakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a.txt", "empty.h5"):
        (tmp_path / name).touch()
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    for name in ("broken.usda", "broken.json"):
        (tmp_path / name).write_text("{")
    for name, layer in (("circle", "circle"), ("outside", "../other")):
        arc = f'def "A" (references = @./{layer}.usda@</A>) {{}}'
        (tmp_path / f"{name}.usda").write_text(f"#usda 1.0\n{arc}")
    described = described_files(tiny_scene(), "s").json.decode()
    (tmp_path / "meshless.json").write_text(described.replace("templates/", "absent.obj/"))
    (tmp_path / "nan.json").write_text(described.replace("0.5", "NaN"))
    write_renderformer_h5(tmp_path / "shapes.h5", tiny_scene())
    with h5py.File(tmp_path / "shapes.h5", "r+") as file:
        del file["vn"]
        file["vn"] = np.zeros((2, 3, 3), np.float32)
    monkeypatch.chdir(tmp_path)
    before = set(tmp_path.iterdir())
    for source, target, message in MISTAKES:
        with case(source):
            assert message in refused(source, target)
        assert set(tmp_path.iterdir()) == before, source


def test_a_crash_in_native_code_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = write_stage(tmp_path)
    use_processes(monkeypatch)
    monkeypatch.setattr(convert_scene, "source_keys", crash)
    told = refused(stage, tmp_path / "a.json")
    assert told.startswith("stage.usda: could not be converted (crashed_signal_11")


def test_budgets_that_cannot_be(tmp_path: Path) -> None:
    stage = write_stage(tmp_path)
    assert "from 1 to" in refused(stage, tmp_path / "a.json", "--budget", "0")
    assert "emitters take" in refused(stage, tmp_path / "a.json", "--budget", "20")
