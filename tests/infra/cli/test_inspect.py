"""`trilight inspect` writes where it may, and prints what it found."""

import dataclasses
import json
import os
from pathlib import Path

import numpy as np
import pytest

from storage.dataset.shard import scan_members
from storage.errors import TrilightError
from storage.records.sample import PartFloor
from tests.command_line import trilight
from tests.infra.run_by_hand import write_run
from tests.pipeline.documents.dataset_by_hand import (
    five_scenes,
    furnished,
    sample,
    write_dataset,
)


def inspect(*arguments: str | Path) -> str:
    result = trilight(["inspect", *(str(argument) for argument in arguments)])
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.usefixtures("bare_reports")
def test_the_report_stands_in_the_dataset(tmp_path: Path) -> None:
    five_scenes(tmp_path)
    printed = inspect(tmp_path)
    assert "5 (1 test, 4 train)" in printed
    assert "report.html" in printed.replace("\n", "")  # a long path is wrapped
    assert (tmp_path / "report.html").exists()
    assert (tmp_path / "contact_sheet.png").exists()
    assert len(list((tmp_path / "report").iterdir())) == 5


def test_a_run_is_summed_up_and_the_command_that_shows_it_named(tmp_path: Path) -> None:
    write_run(tmp_path / "my run")
    printed = inspect(tmp_path / "my run")
    assert f"tensorboard --logdir '{tmp_path}/my run'" in printed and "steps planned" in printed
    assert json.loads(inspect(tmp_path / "my run", "--json"))["steps"] == 12


@pytest.mark.usefixtures("bare_reports")
def test_another_folder(tmp_path: Path) -> None:
    five_scenes(tmp_path / "set")
    before = {path: path.read_bytes() for path in (tmp_path / "set").iterdir()}
    inspect(tmp_path / "set", "--out", tmp_path / "out")
    assert {path: path.read_bytes() for path in (tmp_path / "set").iterdir()} == before
    written = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert written == ["contact_sheet.png", "report", "report.html"]


def test_a_read_only_dataset_is_summed_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    five_scenes(tmp_path)
    # the superuser may write anywhere, so that permissions alone would not do
    monkeypatch.setattr("os.access", lambda path, mode: not mode & os.W_OK)
    printed = inspect(tmp_path)
    assert "5 (1 test, 4 train)" in printed
    assert "--out" in printed
    assert not (tmp_path / "report.html").exists()


@pytest.mark.usefixtures("bare_reports")
def test_json_holds_the_distributions(tmp_path: Path) -> None:
    five_scenes(tmp_path)
    read = json.loads(inspect(tmp_path, "--json"))
    assert read["distributions"]["quantities"]["objects_per_scene"]["max"] == 2
    assert read["licences"] == {"CC-BY-4.0": 1, "CC0-1.0": 3}
    assert read["rejections"][0] == ["scenes", "no_room", 2]
    assert (tmp_path / "report.html").exists()


@pytest.mark.usefixtures("bare_reports")
def test_parts_show_with_their_floors(tmp_path: Path) -> None:
    made = sample(0, furnished(["a"]))
    floors = {
        name: PartFloor(noise_floor_db=db, noise_floor_linear_db=30.0, object_noise_floor_db=39.0)
        for name, db in (("direct", 47.5), ("indirect", 38.25))
    }
    parts = {"direct": made.radiance_rgb, "indirect": np.zeros_like(made.radiance_rgb)}
    views = tuple(dataclasses.replace(view, parts=floors) for view in made.views)
    whole = dataclasses.replace(made, parts_rgb=parts, views=views)
    write_dataset(tmp_path, {"train-000000.tar": [whole]})
    assert "noise floor, indirect median 38.2 dB" in " ".join(inspect(tmp_path).split())
    read = json.loads(inspect(tmp_path, "--json"))
    assert read["part_noise_floor_db"] == {"direct": [47.5] * 2, "indirect": [38.25] * 2}
    (page,) = (tmp_path / "report").glob("*.html")
    assert "view 1, indirect" in page.read_text() and "38.25" in page.read_text()


def _refused(dataset: Path) -> str:
    """Return the one line that `inspect` ends with."""
    result = trilight(["inspect", str(dataset)])
    assert isinstance(result.exception, TrilightError), result.exception
    return str(result.exception)


def test_a_dataset_without_scenes_is_said_to_be_empty(tmp_path: Path) -> None:
    write_dataset(tmp_path, {})
    assert "the dataset is empty" in _refused(tmp_path)
    assert not (tmp_path / "report.html").exists()


def test_a_cut_shard_is_one_sentence_with_what_mends_it(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path / "my set")
    name = dataset.manifest.shards[0].name
    path = dataset.folder.shard(name)
    path.write_bytes(path.read_bytes()[:2000])
    said = _refused(tmp_path / "my set")
    assert said.startswith(f"{name}: 2000 bytes; expected ")
    assert said.endswith(f"run `trilight verify '{tmp_path}/my set' --repair`.")


@pytest.mark.parametrize("suffix", ["json", "scene", "0.exr"])
def test_wrong_bytes_are_one_sentence_with_what_mends_it(suffix: str, tmp_path: Path) -> None:
    """Of the same length, in the middle of each kind of member."""
    dataset = five_scenes(tmp_path)
    shard = dataset.manifest.shards[0]
    path = dataset.folder.shard(shard.name)
    with path.open("rb") as stream:
        members = scan_members(stream, shard.name)
        found = next(member for member in members if member.suffix.startswith(suffix))
    offset, num_bytes = found.offset, found.num_bytes
    data = bytearray(path.read_bytes())
    data[offset : offset + num_bytes] = bytes(255 - byte for byte in data[offset:][:num_bytes])
    path.write_bytes(data)
    assert f"{shard.name}: " in _refused(tmp_path)
    assert "--repair`." in _refused(tmp_path)
