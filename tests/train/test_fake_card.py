"""A step of each kind of network on a graphics card that is not there (fake_card).

On tensors without numbers: forward, loss with LPIPS, backward, clipping, Muon, running mean,
validation, evaluation, checkpoint. A module that stayed behind shows here alone. Functions without
`test_` run in a process of their own.
"""

import dataclasses
import json
import re
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest
import torch

from model.neural_renderer import NeuralRenderer
from model.renderformer import RenderFormer
from storage.dataset.training_data import open_training_data
from tests.for_each import for_each
from tests.train.fake_card import CARD, card_process, fake_card
from tests.train.loss.test_objective import small_weights
from tests.train.toy import toy_scene, write_toy_dataset
from train.evaluation.evaluate import Contest, judged_views
from train.loop.crew import Crew
from train.loss.lpips import LINEAR_FILE, VGG16_FILE, load_lpips
from train.run import train_run
from train.runs import changed_run
from train.settings import TrainSettings
from train.start import Start

pytestmark = pytest.mark.slow("gpu")  # a process and a library of its own


@pytest.fixture(scope="module")
def card(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ProcessPoolExecutor]:
    """A process with a card that is not there."""
    with card_process(tmp_path_factory.mktemp("card")) as process:
        yield process


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("toy")
    write_toy_dataset(folder, train=2, validation=2, resolution=RESOLUTION)
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
    card.submit(train_and_judge, run, size, data, lpips, tmp_path).result()


def test_a_run_goes_on_and_a_second_one_begins_on_a_card(
    card: ProcessPoolExecutor, data: str, lpips: str, tmp_path: Path
) -> None:
    card.submit(resume, data, lpips, tmp_path).result()


def test_the_card_forgives_nothing(card: ProcessPoolExecutor) -> None:
    for mistake, message in {
        "processor": "Expected all tensors to be on the same device|two devices",
        "numpy": "can't convert cuda:0",
        "unique": "unique",
    }.items():
        error = card.submit(mixed_on_the_card, mistake).exception()
        assert error is not None and re.search(message, str(error)), mistake


RESOLUTION = 64
"""One window of the large network's."""


def one_step_of(run: str, size: str) -> TrainSettings:
    """Return a named run at a named size, with one step of two scenes of the toy's."""
    changes = {
        "model": size,
        "resolution": RESOLUTION,
        "num_steps": 1,
        "warmup_steps": 0,
        "scenes_per_step": 2,
        "scenes_per_pass": 2,
        "views_per_scene": 1,
        "log_every": 1,
        "validate_every": 1,
        "checkpoint_every": 1,
        "validation_scenes": 1,
        "from_weights": False,
    }
    return changed_run(run, changes)


def train_and_judge(run: str, size: str, data: str, lpips: str, out: Path) -> None:
    """Train by train_run, evaluate and render."""
    settings = one_step_of(run, size)
    with fake_card():
        start, crew = Start(lpips=lpips), Crew(device=CARD)
        result = train_run(settings, data=[data], out=out, start=start, crew=crew)
        assert result is not None and result.skipped_steps == 0
        network = RenderFormer(settings.model).to(CARD)
        distance = load_lpips(lpips)
        assert distance is not None
        contest = Contest(
            network=network,
            shards=open_training_data([data]).split("validation"),
            resolution=RESOLUTION,
            rivals=None,
            lpips=distance.to(CARD),
            most_scenes=1,
        )
        (view, *_) = judged_views(contest, lambda: None)
        assert view.scores["network"]["lpips"] is not None
        assert NeuralRenderer(network).render(toy_scene(0), RESOLUTION).shape[1:] == (64, 64, 3)


def resume(data: str, lpips: str, out: Path) -> None:
    """Go on with a run on the card, and begin a second stage with it.

    Muon is torch's own there, whatever the processor beside the card has.
    """
    first = dataclasses.replace(one_step_of("builtin", "smoke"), num_steps=2, warmup_steps=1)
    second = dataclasses.replace(one_step_of("finetune", "smoke"), from_weights=True)
    with pytest.MonkeyPatch.context() as patch, fake_card():
        patch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)
        crew = Crew(device=CARD)
        train_run(first, data=[data], out=out / "first", crew=crew)
        checkpoint = out / "first" / "checkpoints" / "step-000000002.safetensors"
        checkpoint.unlink()
        train_run(first, data=[data], out=out / "first", start=Start(resume=True), crew=crew)
        start = Start(begin_with=str(checkpoint), lpips=lpips)
        train_run(second, data=[data], out=out / "second", start=start, crew=crew)
    for name in ("first", "second"):
        record = json.loads((out / name / "settings.json").read_text())
        assert record["muon_precision"] == "bfloat16"


def mixed_on_the_card(name: str) -> None:
    """Make a mistake that a card would not forgive."""
    with fake_card():
        on_card = torch.zeros(4, 3, 16, 16, device=CARD)
        mistakes = {
            "processor": lambda: on_card + torch.zeros(4, 1, 1, 1),
            "numpy": lambda: on_card.numpy(),
            "unique": lambda: on_card.unique(),
        }
        mistakes[name]()
