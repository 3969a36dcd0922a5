"""Simulated datasets are what they say: whole ones verify, outlines open and can go on."""

from pathlib import Path

import pytest

from infra.bench.sides.maker_costs import main as measure_steps
from infra.bench.subjects.simulated_set import write_outline, write_whole
from storage.dataset import verify
from storage.dataset.progress import missing_shards, read_status
from storage.dataset.training_data import open_training_data
from storage.dataset.verify import verify_dataset


def test_whole_shards_verify_to_the_last_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_whole(tmp_path, 9)
    monkeypatch.setattr(verify, "_AHEAD", 2)  # so that findings are taken as others are made
    found = verify_dataset(tmp_path)
    assert found.problems == [] and found.is_finished and found.num_samples == 9
    shard = next(tmp_path.glob("train-*.tar"))
    shard.write_bytes(shard.read_bytes()[:-1] + b"x")
    assert verify_dataset(tmp_path).bad_shards == [shard.name]


def test_an_outline_lacks_its_last_shard_until_a_maker_goes_on(tmp_path: Path) -> None:
    write_outline(tmp_path, 9)
    assert missing_shards(str(tmp_path)) == [8]
    status = read_status(str(tmp_path))
    assert (status.scenes_done, status.scenes_planned) == (64, 72)
    assert status.core_hours == 64 * 12.5 * 2 / 3600
    assert len(open_training_data([str(tmp_path)]).split("train").names) == 6
    measure_steps([str(tmp_path), ""])  # begins, notes the last shard and finishes
    assert missing_shards(str(tmp_path)) == [0]  # all is there; its documents are not
