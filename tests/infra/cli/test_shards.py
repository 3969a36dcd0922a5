"""`trilight shards`: what the commands take and print."""

import json
import shlex
from pathlib import Path

import pytest

from infra.repair import repair
from storage.dataset.dataset import open_dataset
from storage.errors import TrilightError
from tests.command_line import trilight
from tests.pipeline.making.derive_kit import finished, scenes

pytestmark = pytest.mark.usefixtures("bare_reports")


def shards(*arguments: str | Path) -> str:
    result = trilight(["shards", *(str(argument) for argument in arguments)])
    if result.exception is not None:
        raise result.exception
    return result.output


def test_merge_select_and_reshard(tmp_path: Path) -> None:
    a, b = finished(tmp_path / "a", scenes(0)), finished(tmp_path / "b", scenes(1), seed=1)
    printed = shards("merge", a, b, "--out", tmp_path / "ab")
    assert "12 (4 test, 8 train)" in printed and "trilight verify" in printed
    chosen = ("--split", "train", "--template", "plane", "--min-noise-floor", "36.5")
    shards("select", tmp_path / "ab", "--out", tmp_path / "c", *chosen)
    c = open_dataset(str(tmp_path / "c"))
    keys = [key for shard in c.manifest.shards for key in c.keys(shard)]
    assert keys == ["000000003", "000000009"]
    where = 'template == "plane" and min(noise_floor_db) >= 36.5 and split == "train"'
    listed = shards("list", tmp_path / "ab", "--where", where)
    assert "2 of 12 scenes" in listed and "000000009 train" in listed
    words = shlex.split(listed.partition("Next: trilight shards ")[2])
    shards(*words)  # as it is printed
    assert open_dataset(f"{tmp_path / 'ab'}-selected").manifest.num_samples == 2
    rows = json.loads(shards("list", tmp_path / "ab", "--where", where, "--json"))
    assert [row["key"] for row in rows["scenes"]] == ["000000003", "000000009"]
    assert "0 of 12 scenes" in shards("list", tmp_path / "ab", "--where", "max(coverage) > 2")
    size = ("--scenes-per-shard", "5", "--json")
    outcome = json.loads(shards("reshard", tmp_path / "ab", "--out", tmp_path / "d", *size))
    assert outcome["scenes_by_split"] == {"test": 4, "train": 8}
    assert outcome["dataset_digest"] == open_dataset(str(tmp_path / "d")).digest


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    a, out = finished(tmp_path / "a", scenes(0)), tmp_path / "c"
    with pytest.raises(TrilightError, match="1 dataset; expected at least 2"):
        shards("merge", a, "--out", out)
    with pytest.raises(TrilightError, match="expected --where, --split, --template or --min-noise"):
        shards("select", a, "--out", out)
    assert not out.exists()


def test_a_bad_derived_shard_is_made_of_its_sources_again(tmp_path: Path) -> None:
    a, b = finished(tmp_path / "a", scenes(0)), finished(tmp_path / "b", scenes(1), seed=1)
    shards("merge", a, b, "--out", tmp_path / "ab")
    (tmp_path / "ab" / "train-000001.tar").unlink()
    found = trilight(["verify", str(tmp_path / "ab")])
    assert found.exit_code == 1
    assert "Make it again from its sources: trilight shards merge" in found.output
    with pytest.raises(TrilightError, match=r"made by `trilight shards merge`; expected one of"):
        repair(str(tmp_path / "ab"), ["train-000001.tar"], objects=None, scenes_from=None)
    found = trilight(["verify", str(damaged := _without_a_shard(a))])
    assert f"Next: trilight verify {damaged} --repair" in found.output


def _without_a_shard(root: Path) -> Path:
    (root / "train-000000.tar").unlink()
    return root
