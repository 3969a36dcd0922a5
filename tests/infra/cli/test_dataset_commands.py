"""What commands say of a dataset, of a run, and of scene files that they convert."""

import dataclasses
import json
import os
import shlex
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch

from infra.cli import passes as passes_command
from infra.cli.assets import generate_from_meshes
from infra.cli.extend_option import load_extensions
from infra.repair import repair
from infra.run_record import is_run, run_facts
from model.open import open_network
from model.weights import encode_weights
from pipeline.exchange import reader
from pipeline.exchange.reader import load_source, scene_source
from pipeline.exchange.renderformer_h5 import read_renderformer_h5
from pipeline.exchange.renderformer_json import write_renderformer_json
from pipeline.renders.mitsuba_variant import choose_variant
from storage.dataset.dataset import open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import write_manifest
from storage.dataset.progress import announce_objects, log_scene, write_asked
from storage.dataset.shard import write_shard
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.passes import decode_passes_exr, passes_exr
from storage.records.sample import PictureErrors, encode_sample
from storage.records.scene import Scene
from storage.records.scene_file import encode_scene
from tests.command_line import expect_json, expect_mistake, expect_output, trilight
from tests.crash import crash
from tests.extensions_kit import room_for_extensions, written
from tests.for_each import case
from tests.infra.child_here import use_processes
from tests.infra.run_by_hand import write_run
from tests.model.kit import awake, publishable, tiny_config
from tests.pipeline.documents.dataset_by_hand import (
    five_scenes,
    furnished,
    sample,
    write_dataset,
)
from tests.pipeline.exchange.exchange_kit import write_stage
from tests.pipeline.generation.test_dataset_writer import begin_tiny, make_tiny_shard
from tests.pipeline.generation.test_derive_dataset import finished, scenes
from tests.scenes_by_hand import tiny_sample, tiny_scene

pytestmark = pytest.mark.usefixtures("bare_reports", "children_here")


def test_the_report_stands_in_the_dataset(tmp_path: Path) -> None:
    five_scenes(tmp_path)
    printed = expect_output("inspect", tmp_path)
    assert "5 (1 test, 4 train)" in printed
    assert "report.html" in printed.replace("\n", "")  # a long path is wrapped
    assert (tmp_path / "report.html").exists()
    assert (tmp_path / "contact_sheet.png").exists()
    assert len(list((tmp_path / "report").iterdir())) == 5
    read = expect_json("inspect", tmp_path)
    assert read["distributions"]["quantities"]["objects_per_scene"]["max"] == 2
    assert read["licences"] == {"CC-BY-4.0": 1, "CC0-1.0": 3}
    assert read["rejections"][0] == ["scenes", "no_room", 2]


def test_a_run_is_summed_up_by_its_last_numbers_and_damage_is_named(tmp_path: Path) -> None:
    write_run(tmp_path / "my run")
    printed = expect_output("inspect", tmp_path / "my run")
    assert f"tensorboard --logdir '{tmp_path}/my run'" in printed and "steps planned" in printed
    assert expect_json("inspect", tmp_path / "my run")["steps"] == 12
    rows = [line.split() for line in printed.splitlines()]
    assert ["finished", "no"] in rows and ["training", "loss", "0.08333"] in rows
    place = f"'{tmp_path}/my run'"
    resume = f"To resume: trilight train tiny --like {place} --out {place} --resume, with the same"
    assert f"{resume} --data as before." in printed
    (tmp_path / "my run/summary.json").write_text("{}")
    assert "To resume" not in expect_output("inspect", tmp_path / "my run")
    with pytest.raises(TrilightError, match="no run here; expected a folder that `trilight train`"):
        run_facts(tmp_path)
    write_run(tmp_path / "run")
    assert is_run(tmp_path / "run") and not is_run(tmp_path)
    facts = {
        "run": "tiny",
        "steps": 12,
        "steps_planned": 12,
        "finished": False,
        "spikes": 1,
        "training_loss": 1 / 12,
        "validation_log_l1": 0.1,
        "validation_psnr_log_db_median": 20.0,
        "views_per_s": 3.0,
    }
    assert run_facts(tmp_path / "run") == facts
    metrics = tmp_path / "run/metrics.jsonl"
    with metrics.open("a") as log:
        log.write('{"step": 12, "loss": null, "validation": {"log_l1": NaN}}\n')
    (tmp_path / "run/summary.json").write_text("{}")
    assert run_facts(tmp_path / "run") == facts | {"finished": True}
    metrics.write_text("")
    assert run_facts(tmp_path / "run")["steps"] == 0
    for damaged in ("{\n", "[]\n", '{"loss": 1}\n', "3\n"):
        metrics.write_text(damaged)
        with pytest.raises(TrilightError, match="is not readable .* Restore it from a copy"):
            run_facts(tmp_path / "run")


def test_a_dataset_that_is_read_only_stays_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    five_scenes(tmp_path / "set")
    before = {path: path.read_bytes() for path in (tmp_path / "set").iterdir()}
    # the superuser may write anywhere, so that permissions alone would not do
    monkeypatch.setattr("os.access", lambda path, mode: not mode & os.W_OK)
    printed = expect_output("inspect", tmp_path / "set")
    assert "5 (1 test, 4 train)" in printed and "--out" in printed
    expect_output("inspect", tmp_path / "set", "--out", tmp_path / "out")
    assert {path: path.read_bytes() for path in (tmp_path / "set").iterdir()} == before
    written = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert written == ["contact_sheet.png", "report", "report.html"]


def test_parts_show_with_their_floors(tmp_path: Path) -> None:
    made = sample(0, furnished(["a"]))
    floors = {
        name: PictureErrors(
            noise_floor_db=db, noise_floor_linear_db=30.0, object_noise_floor_db=39.0
        )
        for name, db in (("direct", 47.5), ("indirect", 38.25))
    }
    parts = {"direct": made.radiance_rgb, "indirect": np.zeros_like(made.radiance_rgb)}
    views = tuple(dataclasses.replace(view, parts=floors) for view in made.views)
    whole = dataclasses.replace(made, parts_rgb=parts, views=views)
    write_dataset(tmp_path, {"train-000000.tar": [whole]})
    assert "stated error, indirect median 38.2 dB" in " ".join(
        expect_output("inspect", tmp_path).split()
    )
    read = expect_json("inspect", tmp_path)
    assert read["part_noise_floor_db"] == {"direct": [47.5] * 2, "indirect": [38.25] * 2}
    (page,) = (tmp_path / "report").glob("*.html")
    assert "view 1, indirect" in page.read_text() and "38.25" in page.read_text()


def test_an_empty_dataset_and_a_damaged_shard_are_one_sentence(tmp_path: Path) -> None:
    write_dataset(tmp_path, {})
    assert "the dataset is empty" in expect_mistake("inspect", tmp_path)
    assert not (tmp_path / "report.html").exists()
    dataset = five_scenes(tmp_path / "my set")
    name = dataset.manifest.shards[0].name
    path = dataset.folder.shard(name)
    data = path.read_bytes()
    path.write_bytes(data[:600] + bytes(len(data) - 1200) + data[-600:])
    assert f"{name}: " in expect_mistake("inspect", tmp_path / "my set"), "of the same length"
    path.write_bytes(data[:2000])
    said = expect_mistake("inspect", tmp_path / "my set")
    assert said.startswith(f"{name}: 2000 bytes; expected ")
    assert f"`trilight verify '{tmp_path}/my set'` says how" in said


def test_merge_select_and_reshard(tmp_path: Path) -> None:
    a, b = finished(tmp_path / "a", scenes(0)), finished(tmp_path / "b", scenes(1), seed=1)
    printed = expect_output("shards", "merge", a, b, "--out", tmp_path / "ab")
    assert "12 (4 test, 8 train)" in printed and "trilight verify" in printed
    chosen = ("--split", "train", "--template", "plane", "--min-noise-floor", "36.5")
    expect_output("shards", "select", tmp_path / "ab", "--out", tmp_path / "c", *chosen)
    c = open_dataset(str(tmp_path / "c"))
    keys = [key for shard in c.manifest.shards for key in c.keys(shard)]
    assert keys == ["000000003", "000000009"]
    where = 'template == "plane" and min(noise_floor_db) >= 36.5 and split == "train"'
    listed = expect_output("shards", "list", tmp_path / "ab", "--where", where)
    assert "2 of 12 scenes" in listed and "000000009 train" in listed
    words = shlex.split(listed.partition("Next: trilight shards ")[2])
    expect_output("shards", *words)  # as it is printed
    assert open_dataset(f"{tmp_path / 'ab'}-selected").manifest.num_samples == 2
    rows = expect_json("shards", "list", tmp_path / "ab", "--where", where)
    assert [row["key"] for row in rows["scenes"]] == ["000000003", "000000009"]
    assert "0 of 12 scenes" in expect_output(
        "shards", "list", tmp_path / "ab", "--where", "max(coverage) > 2"
    )
    size = ("--scenes-per-shard", "5")
    outcome = expect_json("shards", "reshard", tmp_path / "ab", "--out", tmp_path / "d", *size)
    assert outcome["scenes_by_split"] == {"test": 4, "train": 8}
    assert outcome["dataset_digest"] == open_dataset(str(tmp_path / "d")).digest
    out = ("--out", tmp_path / "e")
    assert "1 dataset; expected at least 2" in expect_mistake("shards", "merge", a, *out)
    lacking = "expected --where, --split, --template or --min-noise-floor"
    assert lacking in expect_mistake("shards", "select", a, *out)
    assert not (tmp_path / "e").exists()
    # a bad derived shard is made of its sources again
    (tmp_path / "ab" / "train-000001.tar").unlink()
    found = trilight(["verify", str(tmp_path / "ab")])
    assert found.exit_code == 1
    assert "Make it again from its sources: trilight shards merge" in found.output
    with pytest.raises(TrilightError, match=r"made by `trilight shards merge`; expected one of"):
        repair(str(tmp_path / "ab"), ["train-000001.tar"], objects=None, scenes_from=None)
    (a / "train-000000.tar").unlink()
    found = trilight(["verify", str(a)])
    assert f"Next: trilight verify {a} --repair" in found.output


def test_a_repair_has_the_objects_of_the_generate_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse = mock.Mock(side_effect=TrilightError("refused"))
    publication = begin_tiny(tmp_path, 4)
    make_tiny_shard(publication, 0)
    write_asked(publication.folder, ["generate", "smoke", "--objects", "mine"])
    monkeypatch.setattr("infra.repair.prepare_dataset", refuse)
    for objects in (None, "others"):
        with pytest.raises(TrilightError, match="refused"):
            repair(str(tmp_path), ["train-000000.tar"], objects=objects, scenes_from=None)
    assert [each.args[0].objects for each in refuse.call_args_list] == ["mine", "others"]
    assert [path.name for path in tmp_path.glob("*.tar*")] == ["train-000000.tar"]


WIDE = {"COLUMNS": "200"}


def test_an_unfinished_set_is_not_verified(tmp_path: Path) -> None:
    publication = begin_tiny(tmp_path / "my set", 12)
    place = str(tmp_path / "my set")
    empty = trilight(["verify", place], env=WIDE)
    assert empty.exit_code == 1
    assert "Unfinished" in empty.output
    assert "Verified" not in empty.output
    make_tiny_shard(publication, 0)
    write_asked(publication.folder, ["generate", "smoke", "--noise-floor", "7"])
    begun = trilight(["verify", place, "--fast"], env=WIDE)
    assert begun.exit_code == 1
    assert "1 of 3" in begun.output
    assert f"Next: trilight generate smoke --noise-floor 7 --out '{place}'" in begun.output
    told = json.loads(trilight(["verify", place, "--fast", "--json"]).output)
    assert (told["finished"], told["shards"], told["shards_planned"]) == (False, 1, 3)
    # words that do not print are not repeated: whoever hands out a dataset may have written them
    for words in (["train", "smoke"], ["generate", "smoke\x1b[2J"], ["generate", "a\nb"]):
        write_asked(publication.folder, words)
        shown = trilight(["verify", place], env=WIDE).output
        assert "Next:" not in shown
        assert "run the trilight generate command that began it" in shown


def test_what_comes_next_names_the_extensions_that_a_dataset_was_made_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where this user has loaded them; no file that somebody else's manifest names."""
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    own, place = written(tmp_path, "VALUE = 7\n"), tmp_path / "set"
    publication = begin_tiny(place, 12)
    write_asked(publication.folder, ["generate", "smoke"])
    recorded = {"own.py": sha256_hex(own.read_bytes()), "b.py": "0" * 64}
    manifest = dataclasses.replace(publication.manifest, extensions=recorded)
    write_manifest(publication.folder.manifest, manifest)
    commands = [[name, str(place)] for name in ("status", "verify")]
    begun = f"Next: trilight generate smoke --out {place}"
    for shown in (trilight(words, env=WIDE).output for words in commands):
        assert begun in shown and "--extend" not in shown
    with room_for_extensions():
        load_extensions(["--extend", str(own)])
    for shown in (trilight(words, env=WIDE).output for words in commands):
        assert f"{begun} --extend {own}\n" in shown


def test_status_says_how_far_and_what_next(tmp_path: Path) -> None:
    publication = begin_tiny(tmp_path, 12)
    make_tiny_shard(publication, 0)
    log_scene(publication.folder, "x", 0, seconds=1800.0, cores=2, num_rejected=0)
    shown = expect_output("status", tmp_path, **WIDE)
    for text in ("1 of 3", "4 of 12", "no_camera", "1.00 core-hours, 0.04 USD", "--scenes 12"):
        assert text in shown
    row = expect_json("status", tmp_path, "--price", "0.5")
    assert (row["shards_done"], row["scenes_planned"], row["finished"]) == (1, 12, False)
    assert row["cost_usd"] == 0.5
    announce_objects(publication.folder, 7)
    said = _status(tmp_path)
    assert "tiny, unfinished objects 0 of 7" in said
    assert "To resume: trilight generate tiny --scenes 12" in said
    with publication.folder.hold_shared_lock():
        assert "tiny, unfinished; a process is making it now objects" in _status(tmp_path)


def _status(place: Path) -> str:
    """Return what status prints, with each blank and line break as one blank."""
    return " ".join(trilight(["status", str(place)], env=WIDE).output.split())


def test_a_finished_copy_that_lacks_a_shard_says_how_to_mend_it(tmp_path: Path) -> None:
    place = finished(tmp_path / "a", scenes(0))
    folder = DatasetFolder(place)
    folder.card.touch()
    for scene in range(2):
        log_scene(folder, "x", scene, seconds=10.0, cores=2, num_rejected=0)
    whole = _status(place)
    assert ", finished shards" in whole and whole.endswith(f"Next: trilight verify {place}")
    (place / "train-000000.tar").unlink()
    said = _status(place)
    assert ", finished; 1 shard missing shards" in said and "left at that rate" not in said
    assert said.endswith(f"Next: trilight verify {place} --repair")


def test_objects_of_one_split_limit_the_scenes_to_that_split() -> None:
    digests = [sha256_hex(str(number).encode()) for number in range(40)]
    words = generate_from_meshes(digests, Path("meshes"), ())
    assert words == ["generate", "smoke", "--objects", "meshes", "--out", "meshes-smoke"]
    training, testing = sha256_hex(b"0"), sha256_hex(b"8")
    assert generate_from_meshes([training], Path("meshes"), ())[-2:] == ["--scenes", "8"]
    words = generate_from_meshes([testing], Path("meshes"), ())
    assert words[-2:] == ["--set", "splits.one_split=true"]


def loaded(path: Path, key: str = "") -> Scene:
    return load_source(scene_source(f"{path}::{key}" if key else str(path))).scene


def test_a_sample_and_a_whole_shard(tmp_path: Path) -> None:
    shard = tmp_path / "train-000000.tar"
    samples = {key: encode_sample(tiny_sample(key)) for key in ("000000003", "000000005")}
    write_shard(shard, samples.items())
    expect_json("convert", f"{shard}::000000005", tmp_path / "one.usdz")
    assert encode_scene(loaded(tmp_path / "one.usdz")) == encode_scene(tiny_scene())
    expect_json("convert", shard, tmp_path / "all.usdc")
    assert loaded(tmp_path / "all.usdc", "000000003").num_triangles == 3
    found = expect_json("convert", tmp_path / "all.usdc", tmp_path / "each.safetensors")
    assert [Path(path).name for path in found["files"]] == [
        "each.000000003.safetensors", "each.000000005.safetensors",
    ]  # fmt: skip
    assert encode_scene(loaded(Path(found["files"][1]))) == encode_scene(tiny_scene())
    # HDF5 takes pictures along, of a shard and of HDF5; a scene without them has none there
    expect_json("convert", f"{shard}::000000003", tmp_path / "a.h5")
    expect_json("convert", tmp_path / "a.h5", tmp_path / "b.h5")
    for name in ("a.h5", "b.h5"):
        stored_rgb = read_renderformer_h5(tmp_path / name).radiance_rgb
        assert stored_rgb is not None
        assert np.array_equal(stored_rgb, tiny_sample().radiance_rgb)
    expect_json("convert", tmp_path / "one.usdz", tmp_path / "c.h5")
    assert read_renderformer_h5(tmp_path / "c.h5").radiance_rgb is None


def test_a_strangers_stage_within_a_budget(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A child that is confined can read the stage and write its scene, as for a user."""
    stage = write_stage(tmp_path, sphere=True)
    for budget, message in (("0", "from 1 to"), ("20", "emitters take")):
        assert message in expect_mistake("convert", stage, tmp_path / "a.json", "--budget", budget)
    fewer = expect_json("convert", stage, tmp_path / "few.safetensors", "--budget", "600")
    use_processes(monkeypatch)
    whole = expect_json("convert", stage, tmp_path / "whole.safetensors")
    assert loaded(tmp_path / "whole.safetensors").environment is not None, "its DomeLight"
    assert fewer["triangles"] <= 600 < whole["triangles"]
    assert any("reduced to" in note for note in fewer["notes"])
    loaded(tmp_path / "few.safetensors").check()


def test_mistakes_and_a_crash_in_native_code_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a.txt", "empty.h5"):
        (tmp_path / name).touch()
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    (tmp_path / "broken.usda").write_text("{")
    meshless = tmp_path / "meshless.json"
    write_renderformer_json(meshless, tiny_scene())
    meshless.write_text(meshless.read_text().replace("templates/", "absent.obj/"))
    monkeypatch.chdir(tmp_path)
    before = set(tmp_path.iterdir())
    for source, target, message in (
        ("absent.usda", "a.json", "no such file"),
        ("a.txt", "a.json", "cannot be read as a scene"),
        ("a.usda", "a.obj", "cannot be written as a scene"),
        ("broken.usda", "a.json", "not readable as USD"),
        ("empty.h5", "a.usda", "not a readable HDF5 file"),
        ("https://x.y/a.usda", "a.json", "only files of this machine"),
        ("meshless.json", "a.usda", "absent.obj"),
    ):
        with case(source):
            assert message in expect_mistake("convert", source, target)
        assert set(tmp_path.iterdir()) == before, source
    stage = write_stage(tmp_path)
    use_processes(monkeypatch)
    monkeypatch.setenv("TRILIGHT_CONFINE", "off")  # a confined child reads no function of tests
    monkeypatch.setattr(reader, "source_keys", crash)
    told = expect_mistake("convert", stage, tmp_path / "a.json")
    assert "stage.usda: could not be read (crashed_signal_11" in told


def test_passes_are_of_the_views_that_are_named_and_take_a_gpu_that_passes_the_probe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a dataset, of one scene of it, and of the file of a scene; what is not there is named."""
    dataset, out = tmp_path / "data", tmp_path / "out"
    scenes = {"train-000000.tar": [0, 1], "test-000001.tar": [2]}
    shards = {name: [sample(i, furnished(["a"])) for i in rows] for name, rows in scenes.items()}
    write_dataset(dataset, shards)
    words = ("--passes", "normal,depth", "--passes", "object", "--device", "cpu", "--out", out)
    found = expect_json("passes", dataset, *words)
    assert found["passes"] == ["object", "depth_axis_m", "shading_normal"]
    assert [Path(path).name for path in found["files"]] == [
        f"{scene:09d}.{view}.passes.exr" for scene in (2, 0, 1) for view in range(2)
    ]
    names = ("object", "depth_axis_m", "shading_normal")
    data = (out / "000000002.1.passes.exr").read_bytes()
    assert data == passes_exr(furnished(["a"]), names, view=1, resolution=16)
    one = ("--scene", "1", "--view", "1", "--resolution", "8", "--rays-a-side", "2")
    (path,) = expect_json("passes", dataset, *one, "--out", tmp_path / "one")["files"]
    assert Path(path).name == "000000001.1.passes.exr"
    assert set(decode_passes_exr(Path(path).read_bytes(), 8)) == {
        *("object", "coverage", "depth_axis_m", "shading_normal")
    }
    file = tmp_path / "floor.safetensors"
    file.write_bytes(encode_scene(tiny_scene()))
    options = ("--view", "0", "--passes", "triangle", "--device", "cpu")
    found = expect_json("passes", file, *options, "--out", tmp_path)
    assert found["files"] == [str(tmp_path / "floor.0.passes.exr")]
    data = (tmp_path / "floor.0.passes.exr").read_bytes()
    assert data == passes_exr(tiny_scene(), ["triangle"], view=0, resolution=256)
    for option, value, message in (
        ("--scene", "9", "no scene 000000009; expected one of its 3"),
        ("--view", "2", "view is 2; expected 0 to 1"),
        ("--passes", "dept", "did you mean depth?"),
        ("--passes", "motion_px", "another moment"),
    ):
        assert message in expect_mistake(
            "passes", dataset, option, value, "--out", tmp_path / "none"
        )
    # here LLVM stands for a GPU; without one `gpu` is refused, and a failed probe is a note
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    on_gpu = ("passes", dataset, "--scene", "1", "--view", "1", "--passes", "object")
    told = expect_mistake(*on_gpu, "--device", "gpu", "--out", tmp_path / "none")
    assert "--device is gpu, and no NVIDIA GPU is visible here" in told
    assert not (tmp_path / "none").exists()
    traced = []
    for probed in ((choose_variant("cpu"), ""), (None, "the GPU renders no right picture")):
        monkeypatch.setattr(passes_command, "choose_gpu", lambda *_, device, found=probed: found)
        with monkeypatch.context() as patched:
            patched.setattr(passes_command, "Surfaces", lambda scene: traced.append(scene))
            notes = expect_json(*on_gpu, "--out", tmp_path / "out")["notes"]
        assert ("see trilight doctor" in str(notes)) == bool(probed[1])
        assert len(traced) == bool(probed[1])


def test_a_size_is_described_and_a_checkpoint_published_too(tmp_path: Path) -> None:
    text = trilight(["model", "base"]).stdout
    for word in ("194.96 M", "692.7 GFLOP", "memory, bfloat16", "cross-attention"):
        assert word in text
    found = expect_json("model", "large", "--views", "4", "--resolution", "512")
    assert sum(found["parameters"].values()) == 483_266_819
    assert found["workload"] == {"resolution": 512, "triangles": 1536, "views": 4}
    assert found["config"]["window_bundles"] == 8
    assert found["weight_bytes"]["bfloat16"] < 0.51 * found["weight_bytes"]["float32"]
    model = awake(publishable("swin"), torch.float32)
    path = tmp_path / "model.safetensors"
    path.write_bytes(encode_weights(model))
    target = tmp_path / "published"
    found = expect_json("model", path, "--publish", target, "--resolution", "64")
    assert found["config"]["window_bundles"] == 8
    again = open_network(str(target))
    for (name, a), b in zip(again.named_parameters(), model.parameters(), strict=True):
        assert torch.equal(a, b), name
    path.write_bytes(encode_weights(awake(tiny_config(), torch.float32)))
    assert "head linear" in expect_mistake("model", str(path), "--publish", str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()
