"""Work is done in a fresh process, and its memory is that of all its processes."""

import itertools
import subprocess
import sys
import time
from pathlib import Path

import pytest

from infra.bench.workloads import sized_work
from infra.bench.workloads.sized_work import WORK, measure_work, session_bytes, sizes_of
from storage.records.sample import encode_sample
from tests.for_each import case
from tests.train.toy import toy_sample


def test_sizes_grow_fourfold_up_to_the_most() -> None:
    for name, work in WORK.items():
        with case(name):
            sizes = sizes_of(work, 5)
            assert sizes[0] == work.least and sizes[-1] <= work.most
            assert all(b == 4 * a for a, b in itertools.pairwise(sizes))


def test_memory_is_that_of_a_session() -> None:
    code = "data = bytearray(60_000_000); data[::4096] = b'x' * len(data[::4096]); input()"
    with subprocess.Popen(
        [sys.executable, "-c", f"{code}"], stdin=subprocess.PIPE, start_new_session=True
    ) as process:
        found = 0
        for _ in range(200):
            found = max(found, session_bytes(process.pid))
            if found > 60e6:
                break
            time.sleep(0.05)
        process.communicate(b"\n")
    assert 60e6 < found < 120e6
    assert session_bytes(process.pid) == 0


@pytest.mark.slow("benchmarks")
def test_every_kind_of_work_is_done_at_its_smallest_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sample = tmp_path / "sample"
    sample.mkdir()
    for name, data in encode_sample(toy_sample(0, resolution=32), "compact").items():
        (sample / name).write_bytes(data)
    for row, (name, work) in enumerate(sized_work.WORK.items()):
        with case(name):
            folder = tmp_path / str(row)
            folder.mkdir()
            found = measure_work(name, work.least, folder)
            assert found["seconds"] > 0 and found["peak_bytes"] > 20e6
