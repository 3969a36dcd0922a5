"""Two real processes, of which one is slow and once very slow; and what a row of the log gets."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from storage.dataset.dataset import Dataset
from tests.conftest import ROOT
from tests.train.kit import tiny_run, trained
from tests.train.toy import write_toy_dataset
from train.folder import RunFolder
from train.watching import spikes
from train.watching.activity import PARTS
from train.watching.rows import read_rows
from train.watching.settings import WatchSettings


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_toy_dataset(tmp_path_factory.mktemp("toy"), train=8, validation=2, per_shard=4)


def test_a_row_tells_parts_memory_and_layers_and_spikes_name_their_scenes(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Spikes by a bound so low that there are some."""
    monkeypatch.setattr(spikes, "LEAST_REMEMBERED", 2)
    monkeypatch.setattr(spikes, "LEAST_DEVIATION", 0.0)
    watched = WatchSettings(spike_bound=1.0)
    result = trained(tiny_run(), [str(dataset.folder.root)], tmp_path, watched=watched)
    rows = read_rows(result.folder.metrics)
    windows = [row for row in rows if "loss" in row]
    assert [row["step"] for row in windows] == [2, 4, 6, 8, 10, 12]
    for row in windows:
        assert set(row["time_s"]) == set(PARTS)
        assert row["time_s"]["forward"] > 0 < row["time_s"]["backward"]
        assert row["memory_mb"].get("process", 100) > 50
        assert "decoder.head" in row["layers"] and "own_s" not in row
    # a window holds the validation and the saving that came before its first step
    assert windows[2]["time_s"]["validation"] > 0 < windows[2]["time_s"]["saving"]
    assert windows[1]["time_s"]["validation"] == 0
    found = [row for row in rows if "spike" in row]
    assert found
    for row in found:
        assert len(row["spike"]["keys"]) == 3 and row["spike"]["value"] > row["spike"]["bound"]
    assert read_rows(result.folder.notes)[0]["text"] == "began on cpu, 1 process"


@pytest.mark.slow("training")
def test_of_two_processes_the_slow_one_and_the_hanging_one_are_named(
    dataset: Dataset, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    words = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    words += ["-m", "tests.train.watching.slow_process", str(dataset.folder.root), str(out)]
    own = {"OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"}
    done = subprocess.run(
        words, cwd=ROOT, env=os.environ | own, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "process 1 of 2 is the slow one" in done.stdout
    first = r"process 0 of 2: step \d+ has taken .* exchange with the other processes"
    second = r"process 1 of 2: step \d+ has taken .* waiting for data\. Stacks"
    assert re.search(first, done.stdout), done.stdout
    assert re.search(second, done.stdout), done.stdout
    assert "went on after all" in done.stdout
    stacks = [path.read_text() for path in RunFolder(out).watching.glob("hang-*-rank-1.txt")]
    assert any("slow_process.py" in text and "sleeping" in text for text in stacks)
    rows = [row for row in read_rows(RunFolder(out).metrics) if "loss" in row]
    fast, slow = (sum(row["own_s"][rank] for row in rows) for rank in range(2))
    assert slow > fast, "seen by their own time, for that of a step is the same"
    assert any(row["time_s"]["exchange"] > 1 for row in rows), "the fast one waits in the exchange"
    texts = [note["text"] for note in read_rows(RunFolder(out).notes)]
    assert "began on cpu, 2 processes" in texts
