"""A step of each kind of network on a graphics card that is not there (fake_card).

On tensors without numbers: forward, loss with LPIPS, backward, clipping, Muon, running mean,
validation, evaluation, checkpoint. A module that stayed behind shows here alone.
"""

import re
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest
import torch

from tests.for_each import for_each
from tests.train import card_cases
from tests.train.fake_card import card_process
from tests.train.loss.test_lpips import small_weights
from tests.train.toy import write_toy_dataset
from train.loss.lpips import LINEAR_FILE, VGG16_FILE

pytestmark = pytest.mark.slow("gpu")  # a process and a library of its own


@pytest.fixture(scope="module")
def card(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ProcessPoolExecutor]:
    """A process with a card that is not there."""
    with card_process(tmp_path_factory.mktemp("card")) as process:
        yield process


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("toy")
    write_toy_dataset(folder, train=2, validation=2, resolution=card_cases.RESOLUTION)
    return str(folder)


@pytest.fixture(scope="module")
def lpips(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A folder of files like the published ones, with few channels."""
    folder = tmp_path_factory.mktemp("lpips")
    for name, weights in zip((VGG16_FILE, LINEAR_FILE), small_weights(), strict=True):
        torch.save(weights, folder / name)
    return str(folder)


@for_each(("run", "size"), [("pretrain", "smoke"), ("hits", "hits-smoke")])
def test_each_view_stage_takes_its_step_on_a_card(
    run: str, size: str, card: ProcessPoolExecutor, data: str, lpips: str, tmp_path: Path
) -> None:
    card.submit(card_cases.train_and_judge, run, size, data, lpips, tmp_path).result()


def test_a_run_goes_on_and_a_second_one_begins_on_a_card(
    card: ProcessPoolExecutor, data: str, lpips: str, tmp_path: Path
) -> None:
    card.submit(card_cases.resume, data, lpips, tmp_path).result()


def test_the_card_forgives_nothing(card: ProcessPoolExecutor) -> None:
    for mistake, message in {
        "processor": "Expected all tensors to be on the same device|two devices",
        "numpy": "can't convert cuda:0",
        "unique": "unique",
    }.items():
        error = card.submit(card_cases.mixed_on_the_card, mistake).exception()
        assert error is not None and re.search(message, str(error)), mistake
