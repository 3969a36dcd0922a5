"""One thread for tiny tensors: two would spend their time waiting for each other."""

from collections.abc import Iterator

import pytest
import torch

from storage.dataset.dataset import Dataset
from tests.train.toy import write_toy_dataset


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Nine scenes of two views; for reading only."""
    return write_toy_dataset(tmp_path_factory.mktemp("toy"), train=7, validation=2, per_shard=3)
