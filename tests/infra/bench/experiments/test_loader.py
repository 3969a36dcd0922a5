"""Every layout is unpacked whole, and batches are read as training reads them."""

from pathlib import Path

import pytest

from infra.bench.experiments.loader import read_figures
from infra.bench.workloads.manifests import write_copies
from infra.bench.workloads.packed_samples import LAYOUTS, unpacking_figures
from storage.dataset.training_data import open_training_data
from storage.records.sample import encode_sample
from tests.infra.bench.bench_kit import measured_rows
from tests.train.toy import toy_sample


def test_our_profiles_take_fewer_bytes_than_the_published_layout(tmp_path: Path) -> None:
    samples = [toy_sample(number, resolution=32) for number in range(2)]
    found = {layout: unpacking_figures(samples, layout, tmp_path) for layout in LAYOUTS}
    sizes = {layout: figures["bytes"] for layout, figures in found.items()}
    assert sizes["compact"] <= sizes["lossless"] < sizes["HDF5 float16"] < sizes["HDF5 float32"]
    assert all(figures["sample_ms"] > 0 for figures in found.values())


def test_copies_are_read_by_any_number_of_threads(tmp_path: Path) -> None:
    members = [
        encode_sample(toy_sample(number, resolution=64, views=4), "compact") for number in range(2)
    ]
    count = write_copies(tmp_path, members, copies=4, per_shard=3)
    data = open_training_data([str(tmp_path)])
    assert count == 8 and len(data.split("train").names) == 3
    for threads in (0, 2):
        assert read_figures(data, count, threads)["sample_ms"] > 0


@pytest.mark.slow("benchmarks")
def test_the_loader_on_rendered_scenes(tmp_path: Path) -> None:
    found = measured_rows("loader", tmp_path)
    assert found["unpack, compact"].point.default
    assert found["batches, 2 threads"].values["samples a second"] > 1
