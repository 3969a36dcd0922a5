"""One thread for tiny tensors: two would spend their time waiting for each other."""

import pytest

from storage.dataset.dataset import Dataset
from tests.model.conftest import one_thread as one_thread
from tests.train.toy import write_toy_dataset


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Nine scenes of two views; for reading only."""
    return write_toy_dataset(tmp_path_factory.mktemp("toy"), train=7, validation=2, per_shard=3)
