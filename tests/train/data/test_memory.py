"""What the reader holds does not grow with the dataset: looked at in a fresh process each."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from storage.dataset.shard import write_shard
from storage.records.sample import Sample, encode_sample, sample_key
from tests.conftest import ROOT
from tests.train.toy import toy_sample

SHARDS, PER_SHARD, RESOLUTION = 30, 8, 128

CHILD = """
import itertools, json, resource, sys
from contextlib import closing
from storage.dataset.training_data import open_training_data
from train.data.order import RankShare
from train.data.stream import StreamSettings, stream_batches
from train.data.unusable import Unusable
settings = StreamSettings(seed=0, window=2, batch_size=8, resolution=16, views_per_scene=2)
data = open_training_data([sys.argv[1]]).split("train")
batches = stream_batches(
    data, settings, 0, share=RankShare(), workers=2, unusable=Unusable(0)
)
count = peak = 0
with closing(batches):
    for batch in itertools.islice(batches, int(sys.argv[2])):
        count += len(batch)
        pages = int(open("/proc/self/statm").read().split()[1])
        peak = max(peak, pages * resource.getpagesize())
print(json.dumps([count, peak]))
"""


def noisy(index: int) -> Sample:
    """A sample whose pictures cannot be packed into less."""
    rng = np.random.default_rng(index)
    picture = rng.random((2, RESOLUTION, RESOLUTION, 3)).astype(np.float32)
    return dataclasses.replace(
        toy_sample(0, resolution=8), key=sample_key(index), radiance_rgb=picture
    )


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("large")
    for number in range(SHARDS):
        samples = [noisy(PER_SHARD * number + row) for row in range(PER_SHARD)]
        write_shard(
            folder / f"train-{number:06d}.tar", [(s.key, encode_sample(s)) for s in samples]
        )
    return folder


def peak_bytes(folder: Path, num_shards: int) -> int:
    """Return the most memory of a process that reads so many shards once."""
    pattern = f"{folder}/train-{{000000..{num_shards - 1:06d}}}.tar"
    command = [sys.executable, "-c", CHILD, pattern, str(num_shards * PER_SHARD // 8)]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    count, peak = json.loads(ran.stdout)
    assert count == num_shards * PER_SHARD
    return int(peak)


@pytest.mark.slow("memory")
def test_the_reader_holds_as_much_of_a_large_set_as_of_a_small_one(shards: Path) -> None:
    """6 shards of 1.4 MB and 30: what is read grows by 33 MB, more when it is unpacked."""
    more = sum(path.stat().st_size for path in shards.iterdir()) * (SHARDS - 6) // SHARDS
    grown = peak_bytes(shards, SHARDS) - peak_bytes(shards, 6)
    # a tenth of what was read leaves room for what the allocator keeps; measured: 0.5 MB
    assert grown < more / 10
