"""How runs begin: from given weights, with the term that was asked for, and not dead."""

import dataclasses
import json
import os
import signal
from pathlib import Path

import pytest
import torch

from model.open import open_network
from storage.dataset.dataset import Dataset
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.train.kit import TINY_MODEL, tiny_run, trained
from tests.train.toy import write_toy_dataset
from train.loop.checkpoints import (
    network_of_run,
    path_of_step,
    read_checkpoint,
    saved_steps,
)
from train.progress import TrainProgress
from train.run import train_run
from train.settings import LossSettings, TrainSettings
from train.start import Start


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_toy_dataset(tmp_path_factory.mktemp("toy"), train=7, validation=2, per_shard=3)


def run(settings: TrainSettings, dataset: Dataset, out: Path, start: Start) -> None:
    train_run(settings, data=[str(dataset.folder.root)], out=out, start=start)


def test_a_second_stage_begins_with_the_first(dataset: Dataset, tmp_path: Path) -> None:
    """With its configuration, whatever the run's own says, and resumes without naming it."""
    first = dataclasses.replace(TINY_MODEL, hidden_width=64)
    run(tiny_run(model=first, num_steps=4), dataset, tmp_path / "first", Start())
    second = tiny_run(from_weights=True, learning_rate=1e-12, warmup_steps=0, num_steps=4)
    place = str(tmp_path / "first")
    run(second, dataset, tmp_path / "second", Start(begin_with=place))
    before, after = (open_network(tmp_path / name, network_of_run) for name in ("first", "second"))
    assert after.config == first
    for name, weight in after.state_dict().items():
        # a learning rate of 1e-12 moves nothing that float32 shows but numbers near 0
        torch.testing.assert_close(weight, before.state_dict()[name], rtol=1e-6, atol=1e-10)
    run(second, dataset, tmp_path / "second", Start(resume=True))
    with pytest.raises(TrilightError, match="weights, and none are named; expected begin_with"):
        run(second, dataset, tmp_path / "third", Start())
    with pytest.raises(TrilightError, match="or --set from_weights=true to begin with those"):
        run(tiny_run(), dataset, tmp_path / "third", Start(begin_with=place))
    with pytest.raises(TrilightError, match="no such file or folder"):
        run(second, dataset, tmp_path / "third", Start(begin_with=str(tmp_path / "none")))


def test_a_run_without_the_weights_it_asks_for_does_not_begin(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("TRILIGHT_LPIPS", raising=False)
    with pytest.raises(TrilightError, match="--set loss.perceptual=ms_ssim or none"):
        run(tiny_run(loss=LossSettings(perceptual="lpips")), dataset, tmp_path, Start())
    assert not list(tmp_path.iterdir())
    other = tiny_run(loss=LossSettings(perceptual="ms_ssim"), num_steps=3)
    run(other, dataset, tmp_path, Start())


def test_a_dead_start_is_said_early_and_once(dataset: Dataset, tmp_path: Path) -> None:
    """A learning rate of nearly nothing leaves the black start black."""
    small = tiny_run(
        num_steps=54,
        warmup_steps=2,
        resolution=8,
        scenes_per_step=1,
        views_per_scene=1,
        validate_every=54,
        checkpoint_every=54,
    )
    dead = dataclasses.replace(small, learning_rate=1e-12)
    with pytest.raises(TrilightError, match=r"collapsed at the start: after 52 steps .*--resume"):
        run(dead, dataset, tmp_path / "dead", Start())
    assert saved_steps((tmp_path / "dead") / "checkpoints") == [52]
    run(dead, dataset, tmp_path / "dead", Start(resume=True))
    run(small, dataset, tmp_path / "alive", Start())


def have_bfloat16(patch: pytest.MonkeyPatch, quick: bool) -> None:
    """Be a processor with products in bfloat16, or one without."""
    patch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: quick)


class StopAfterEachStep(TrainProgress):
    """A scheduler whose time is up after one step."""

    def advance(self, **_: object) -> None:
        os.kill(os.getpid(), signal.SIGTERM)


@for_each("muon_rate, quick", [(0.0, True), (3.0, True), (3.0, False)])
def test_resumed_after_every_step_is_uninterrupted(
    dataset: Dataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    muon_rate: float,
    quick: bool,
) -> None:
    """With a running mean, every symmetry that toy scenes have, and a perceptual term."""
    have_bfloat16(monkeypatch, quick)
    settings = tiny_run(
        num_steps=4,
        ema_decay=0.9,
        muon_rate=muon_rate,
        loss=LossSettings(perceptual="ms_ssim", noise_half=0.01),
        log_every=1,
        validate_every=4,
    )
    data, out = [str(dataset.folder.root)], tmp_path / "stopped"
    whole = trained(settings, data, tmp_path / "whole")
    for step in (1, 2, 3):
        with pytest.raises(TrilightError, match=f"stopped at step {step} "):
            trained(settings, data, out, resume=step > 1, progress=StopAfterEachStep())
    again = trained(settings, data, out, resume=True)
    assert again.folder.weights.read_bytes() == whole.folder.weights.read_bytes()


def test_lights_that_are_not_apart_cannot_be_mixed(dataset: Dataset, tmp_path: Path) -> None:
    mixing = dataclasses.replace(tiny_run().augmentation, light_mix=4.0)
    with pytest.raises(TrilightError, match="its lights are not kept apart"):
        run(tiny_run(augmentation=mixing), dataset, tmp_path, Start())


class Notes(TrainProgress):
    def __init__(self) -> None:
        self.texts: list[str] = []

    def noted(self, text: str) -> None:
        self.texts.append(text)


def test_a_run_goes_on_past_a_damaged_checkpoint_to_the_same_weights(
    dataset: Dataset, tmp_path: Path
) -> None:
    settings, data = tiny_run(num_steps=8, checkpoints_kept=3), [str(dataset.folder.root)]
    whole = trained(settings, data, tmp_path)
    weights, path = whole.folder.weights.read_bytes(), path_of_step(whole.folder.checkpoints, 8)
    damaged = bytearray(path.read_bytes())
    damaged[-4] ^= 4
    path.write_bytes(damaged)
    with pytest.raises(TrilightError, match=f"{path} is not readable"):
        open_network(path, network_of_run)
    notes = Notes()
    again = trained(settings, data, tmp_path, resume=True, workers=1, progress=notes)
    assert [str(path) in text for text in notes.texts] == [True]
    assert again.folder.weights.read_bytes() == weights
    assert open_network(path, network_of_run).config == settings.model, "it was written again"


def test_a_network_with_windows_is_trained(dataset: Dataset, tmp_path: Path) -> None:
    """As the large one is: a DPT on windows, whole ones and shifted ones."""
    model = dataclasses.replace(
        TINY_MODEL,
        decoder_layers=2,
        window_bundles=2,
        head="dpt",
        dpt_features=4,
        dpt_channels=(4, 4, 4, 4),
        dpt_taps=(0, 1, 0, 1),
    )
    settings = tiny_run(model=model, resolution=32, num_steps=20, learning_rate=5e-3)
    result = trained(settings, [str(dataset.folder.root)], tmp_path)
    # 0.80 and 0.88 of it with two seeds
    assert result.skipped_steps == 0 and result.loss_at_end < 0.95 * result.loss_at_start


def test_muon_goes_on_in_another_precision_on_another_processor(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings, data = tiny_run(muon_rate=3.0, checkpoints_kept=3), [str(dataset.folder.root)]
    have_bfloat16(monkeypatch, True)
    whole = trained(settings, data, tmp_path)
    assert json.loads(whole.folder.settings.read_text())["muon_precision"] == "bfloat16"
    weights = open_network(tmp_path, network_of_run).state_dict()
    checkpoints = whole.folder.checkpoints
    path_of_step(checkpoints, 12).unlink()
    begun_at = read_checkpoint(path_of_step(checkpoints, 8)).network().state_dict()
    have_bfloat16(monkeypatch, False)
    notes = Notes()
    trained(settings, data, tmp_path, resume=True, workers=1, progress=notes)
    assert ["Muon's products in float32 instead of bfloat16" in text for text in notes.texts] == [1]
    assert read_checkpoint(path_of_step(checkpoints, 12)).header["muon_precision"] == "float32"
    resumed = open_network(tmp_path, network_of_run).state_dict()
    apart = sum((resumed[name] - weights[name]).square().sum() for name in weights)
    way = sum((weights[name] - begun_at[name]).square().sum() for name in weights)
    # measured 0.095: the rounding of four steps, and what gradients then differ; without the
    # memories of the first eight it would be 0.85
    assert 0 < apart < 0.15**2 * way
