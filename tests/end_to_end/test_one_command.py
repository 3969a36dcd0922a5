"""`trilight generate` on real files, and mistakes that one line answers."""

import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.exchange.exports.pictures import stands_alone
from storage.conventions import preview_srgb8
from storage.dataset.dataset import open_dataset
from storage.dataset.layout import DatasetFolder
from storage.records.lights import light_sources, sum_of_lights
from storage.records.objects import read_failures
from storage.records.passes import view_passes
from tests.command_line import expect_mistake, expect_output, run_program
from tests.conftest import ROOT
from tests.end_to_end.conftest import Trilight
from tests.end_to_end.production_kit import SIXTEEN_SAMPLES
from tests.foreign_packages import foreign_packages, nerfstudio_pictures
from tests.scenes_by_hand import stage_scene

BAD_INPUT = [
    (("generate", "nonsense"), "dataset preset 'nonsense' is unknown; expected one of tiny, smoke"),
    (("generate", "smoke", "--objects", "nowhere"), "nowhere"),
    (("generate", "smoke", "--objects", "broken"), "none was accepted"),
    (("generate", "smoke", "--objects", "twice"), "objects.jsonl:2: uid 'a' is already used"),
    (("generate", "smoke", "--out", "/proc/nowhere"), "cannot write"),
    (("generate", "smoke", "--resolution", "100"), "resolution"),
    (("generate", "smoke", "--runner", "ray"), "--runner is 'ray'"),
    (("generate", "smoke", "--runner", "dask"), "--address is None"),
    (("generate", "smoke", "--address", "tcp://127.0.0.1:9"), "--runner is threads"),
    (("generate", "smoke", "--shards", "7"), "--range is '7'"),
    (
        ("generate", "smoke", "--scenes", "8", "--shards", "2:4"),
        "--range is '2:4'; expected one that begins below 2",
    ),
    (("generate", "smoke", "--out", "broken/torn.stl"), "torn.stl is a file; expected a folder"),
    (
        ("generate", "smoke", "--objects", "env:TRILIGHT_SOURCE_X"),
        "'TRILIGHT_SOURCE_X' is not set",
    ),
    (("verify", "empty"), "no manifest.json"),
    (("verify", "http://127.0.0.1:1/set", "--repair"), "cannot be read"),
    (("verify", "nowhere"), "nowhere: no such folder; expected a dataset"),
    (("train", "smoke", "--data", "empty"), "no manifest.json"),
    (("train", "tyni"), "training preset 'tyni' is unknown; did you mean tiny?"),
    (("shards", "select", "empty", "--out", "c", "--split", "no"), "--split is 'no'"),
]


def test_bad_input_is_one_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "torn.stl").write_bytes(b"solid nothing")
    (tmp_path / "twice").mkdir()
    row = {"uid": "a", "path": "a.stl", "title": "", "licence": "CC0-1.0", "attribution": "",
           "source_url": ""}  # fmt: skip
    (tmp_path / "twice" / "a.stl").write_bytes(b"solid nothing")
    (tmp_path / "twice" / "objects.jsonl").write_text(2 * (json.dumps(row) + "\n"))
    for arguments, message in BAD_INPUT:
        assert message in expect_mistake(*arguments), arguments


EXACT = (
    *("--resolution", "64", "--noise-floor", "20", "--json", *SIXTEEN_SAMPLES),
    *("--set", 'storage.profile="lossless"'),  # so that a sample that was read is staged as it was
)


@pytest.fixture
def scenes(shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder, of the one in use, with two scenes, and with the meshes of all."""
    monkeypatch.chdir(tmp_path)
    source = shared / "renderformer_scenes"
    for name in ("objects", "templates"):
        shutil.copytree(source / name, tmp_path / "scenes" / name)
    for name in ("cbox", "crystals"):
        shutil.copy(source / f"{name}.json", tmp_path / "scenes")
    return tmp_path / "scenes"


@pytest.mark.slow("commands")
def test_existing_scenes_become_a_dataset(trilight: Trilight, scenes: Path, tmp_path: Path) -> None:
    def generate(out: str, *more: str) -> dict[str, object]:
        made = trilight("generate", "smoke", "--scenes-from", "scenes", "--out", out, *EXACT, *more)
        return dict(json.loads(made.stdout[made.stdout.index("{") :]))

    outcome = generate("set")
    assert (outcome["scenes"], outcome["views"], outcome["notes"]) == (2, 2, [])
    trilight("verify", "set")

    dataset = open_dataset(str(tmp_path / "set"))
    (shard,) = dataset.manifest.shards
    assert (shard.name, shard.split) == ("test-000000.tar", "test")
    samples = list(dataset.read_shard(shard))
    assert [sample.scene.provenance["scene_file"]["name"] for sample in samples] == [
        "cbox.json",
        "crystals.json",
    ]
    for sample in samples:
        assert sample.radiance_rgb.shape == (1, 64, 64, 3)
        assert sample.radiance_rgb.mean() > 0.01

    # as a kill leaves it: no shard, and one of its two scenes finished
    (tmp_path / "set" / shard.name).unlink()
    stage_scene(dataset.folder.staged_shard(shard.name), 0, samples[0], [], "lossless")
    log = dataset.folder.logs / f"{shard.name}.jsonl"
    before = len(log.read_text().splitlines())
    assert generate("set")["dataset_digest"] == outcome["dataset_digest"]
    assert len(log.read_text().splitlines()) == before + 1

    whole = (tmp_path / "set" / shard.name).read_bytes()
    damaged = bytearray(whole)
    damaged[len(damaged) // 2] ^= 1
    (tmp_path / "set" / shard.name).write_bytes(damaged)
    assert "expected --scenes-from FOLDER" in expect_mistake("verify", "set", "--repair")
    trilight("verify", "set", "--repair", "--scenes-from", "scenes")
    assert (tmp_path / "set" / shard.name).read_bytes() == whole
    assert open_dataset(str(tmp_path / "set")).manifest == dataset.manifest

    with (scenes / "objects/cbox/tall-box.obj").open("a") as stream:
        stream.write("\n")
    changed = expect_mistake("generate", "smoke", "--scenes-from", "scenes", "--out", "set", *EXACT)
    assert "scene files: 'objects/cbox/tall-box.obj' has changed" in changed
    assert DatasetFolder(tmp_path / "set").shard(shard.name).exists()


def test_bad_scenes_are_one_clear_line(scenes: Path, tmp_path: Path) -> None:
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "bad.json").write_text('{"scene_name": "x", "version": "1.0"}')
    for arguments, message in (
        (("--scenes-from", "bad"), "none of the 1 scene files is usable; the first: bad.json: "),
        (("--scenes-from", "scenes", "--albedo-over-one", "no"), "expected one of scale, refuse"),
        (("--scenes-from", "nowhere"), "no such folder"),
        (("--views", "2"), "--views is 2"),
    ):
        assert message in expect_mistake("generate", "smoke", "--out", "set", *arguments)


@pytest.mark.slow("commands")
def test_a_bad_file_and_a_dark_scene_cost_themselves(
    trilight: Trilight, scenes: Path, tmp_path: Path
) -> None:
    """The first of three is no scene, the second dark; the third has albedos that add up to 1.1."""
    (scenes / "bad.json").write_text('{"scene_name": "x", "version": "1.0", "objects": {}}')
    dark = json.loads((scenes / "cbox.json").read_text())
    dark["objects"]["light_0"]["material"]["emissive"] = [0.1, 0.1, 0.1]
    (scenes / "cbox.json").write_text(json.dumps(dark))
    bright = json.loads((scenes / "crystals.json").read_text())
    bright["objects"]["background_0"]["material"] |= {"diffuse": [0.6] * 3, "specular": [0.5] * 3}
    (scenes / "crystals.json").write_text(json.dumps(bright))
    arguments = ("--scenes-from", "scenes", "--out", "set", "--failure-budget", "0.4")
    made = trilight("generate", "smoke", *arguments, *EXACT)
    outcome = json.loads(made.stdout[made.stdout.index("{") :])
    assert (outcome["scenes"], outcome["scenes_given_up"]) == (1, 2)
    assert any("background_0: diffuse + specular is 1.1000" in note for note in outcome["notes"])
    failures = read_failures(DatasetFolder(tmp_path / "set").failures)
    rows = sorted(failures, key=lambda row: row.item)
    assert [(row.item, row.reason, row.attempt) for row in rows] == [
        ("000000000", "unusable_scene_file", 0),
        ("000000001", "black_view", 0),
    ]
    assert "bad.json: 0 objects; expected 1 to 8192." in rows[0].message
    trilight("verify", "set")
    again = trilight("generate", "smoke", *arguments, *EXACT, "--workers", "2")
    assert json.loads(again.stdout)["dataset_digest"] == outcome["dataset_digest"]
    # it would be another set
    strict = expect_mistake("generate", "smoke", *arguments, *EXACT, "--albedo-over-one", "refuse")
    assert "'crystals.json' is missing" in strict


def _generate(out: Path, *words: str) -> None:
    fewer = ["--resolution", "32", "--set", "splits.scenes_per_shard=2", *SIXTEEN_SAMPLES]
    expect_output("generate", *words, "--objects", "builtin:6", *fewer, "--out", out)


@pytest.mark.slow("commands")
def test_objects_alone_from_the_preset_to_the_exports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path, str(foreign_packages())])
    made = tmp_path / "views"
    views = ["--set", "scenes.num_views=12", "--set", "scenes.skies.maps.height=16"]
    _generate(made, "object-views", "--scenes", "2", *views)
    expect_output("verify", made)
    for sample in open_dataset(str(made)).samples("train"):
        assert stands_alone(sample.scene)
        assert [row.kind for row in sample.scene.objects] == ["object"]
        distance = np.linalg.norm(sample.scene.c2w[:, :3, 3], axis=1)
        np.testing.assert_allclose(distance, 1.6, rtol=1e-5)
        towards = sample.scene.c2w[:, :3, 3] / distance[:, None]
        heights = np.sort(towards[:, 2])
        np.testing.assert_allclose(np.diff(heights), 2 / 12, rtol=1e-3)  # equal areas
        seen = np.linalg.norm(sample.scene.vertex_positions, axis=1)
        assert seen.max() == pytest.approx(0.5, rel=0.05)
    out = tmp_path / "nerfstudio"
    expect_output("export", made, "--form", "nerfstudio", "--out", out)
    for sample in open_dataset(str(made)).samples("train"):
        for view, rgba in nerfstudio_pictures(out / sample.key, sample).items():
            covered = view_passes(
                sample.scene, ["coverage"], view=view, resolution=32, rays_a_side=4
            )["coverage"]
            assert rgba.shape == (32, 32, 4) and {0.0, 1.0} < set(np.unique(covered))
            np.testing.assert_allclose(rgba[..., 3], np.round(255 * covered) / 255, rtol=1e-6)


@pytest.mark.slow("commands")
def test_the_page_relights_a_scene_one_light_at_a_time(tmp_path: Path) -> None:
    skies = ["--set", "scenes.skies.share=1", "--set", "scenes.skies.maps.height=16"]
    skies += ["--set", "scenes.num_views=1"]
    _generate(tmp_path / "data/olat", "olat", "--scenes", "1", *skies)
    expect_output("verify", tmp_path / "data/olat")
    (block,) = re.findall(
        r"```python\n(.*?)```", (ROOT / "docs/how-to/olat.md").read_text(), re.DOTALL
    )
    assert len([line for line in block.splitlines() if line.strip()]) <= 10
    (tmp_path / "block.py").write_text(block)
    printed = run_program([sys.executable, "block.py"], tmp_path).stdout
    (sample,) = open_dataset(str(tmp_path / "data/olat")).samples("train")
    assert sample.lights_rgb is not None and sample.views[0].lights is not None
    lights = sample.lights_rgb[0]
    assert len(lights) == len(light_sources(sample.scene)) > 2
    np.testing.assert_array_equal(sum_of_lights(lights), sample.radiance_rgb[0])
    assert json.loads(printed) == [floor.noise_floor_db for floor in sample.views[0].lights]
    relit = lights[0] * np.array([4, 1, 0.2], np.float32) + np.float32(0.25) * lights[1:].sum(
        axis=0
    )
    with Image.open(tmp_path / "relit.png") as picture:
        difference = np.asarray(picture).astype(int) - preview_srgb8(relit)
    assert np.abs(difference).max() <= 1
