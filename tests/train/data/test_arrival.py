"""The way to the network: the same batches on every device."""

import contextlib
import dataclasses
import itertools
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from storage.conventions import log10_radiance
from storage.dataset.dataset import Dataset
from storage.dataset.training_data import open_training_data
from tests.for_each import for_each
from tests.train.toy import write_toy_dataset
from train.data.arrival import CopyStream, StepScenes, step_scenes
from train.data.order import RankShare
from train.data.scenes import stored_levels
from train.data.stream import StreamSettings, stream_batches
from train.data.unusable import Unusable
from train.settings import AugmentationSettings

LIT = AugmentationSettings(mirror=True, channels=True, light_scale=3.0)
CPU = torch.device("cpu")
SETTINGS = StreamSettings(
    seed=2, window=2, batch_size=6, resolution=16, views_per_scene=2, augmentation=LIT
)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("toy")
    return write_toy_dataset(folder, train=6, validation=1, per_shard=3, resolution=16)


@contextlib.contextmanager
def steps(
    dataset: Dataset, device: torch.device = CPU, **changes: Any
) -> Iterator[Iterator[StepScenes]]:
    settings = dataclasses.replace(SETTINGS, **changes)
    batches = stream_batches(
        open_training_data([str(dataset.folder.root)]).split("train"),
        settings,
        0,
        share=RankShare(),
        workers=2,
        unusable=Unusable(0),
    )
    with closing(batches), closing(step_scenes(batches, float, 3, device)) as found:
        yield found


@for_each("augmentation", [None, LIT])
def test_targets_that_are_looked_up_on_arrival_are_the_same_bits(
    dataset: Dataset, augmentation: AugmentationSettings | None
) -> None:
    """One table of all scenes, or one of each whose light was scaled."""
    pairs = []
    for looked_up in (True, False):
        with steps(dataset, looked_up=looked_up, augmentation=augmentation) as found:
            taken = list(itertools.islice(found, 2))
            pairs.append([batch for step in taken for batch in step.batches])
    for ready, rows in zip(*pairs, strict=True):
        assert ready.levels_BL is None and rows.levels_BL is not None
        assert rows.target_BVRR3.dtype == torch.int16, "half of the bytes on the way"
        assert len(rows.levels_BL) == (1 if augmentation is None else len(rows.noise_BV))
        there = rows.to(CPU)
        assert there.levels_BL is None and torch.equal(there.target_BVRR3, ready.target_BVRR3)


def test_batches_are_made_ahead_and_closing_ends_the_thread(dataset: Dataset) -> None:
    before = threading.active_count()
    with steps(dataset) as found:
        step = next(found)
        assert sorted(step.keys) == [f"00000000{row}" for row in range(6)]
        assert sum(len(batch.noise_BV) for batch in step.batches) == 6
        assert [len(batch.noise_BV) for batch in step.batches] == [3, 3] or len(step.batches) > 2
        assert CopyStream(CPU).send(step.batches) == step.batches
    assert threading.active_count() == before


def test_rows_of_targets_cover_all_that_a_picture_may_hold() -> None:
    halves = np.arange(0x7C00, dtype=np.uint16).view(np.float16).astype(np.float32)
    assert np.array_equal(stored_levels().numpy(), log10_radiance(halves).astype(np.float32))


def test_a_scene_of_another_resolution_has_no_rows(tmp_path: Path) -> None:
    data = write_toy_dataset(tmp_path, train=6, validation=1, per_shard=3, resolution=32)
    with steps(data, looked_up=False) as found:
        assert all(batch.levels_BL is None for batch in next(found).batches)
