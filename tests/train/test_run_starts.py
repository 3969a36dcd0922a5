"""How and where runs begin: from given weights, with the term that was asked for, and not dead.

And a run from a server, or from a list, is the run from the folder.
"""

import dataclasses
import json
import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load

from model.checkpoint_format import path_of_step, saved_steps
from model.open import open_network
from storage.dataset.dataset import Dataset
from storage.dataset.training_data import NO_MANIFEST
from storage.errors import TrilightError
from storage.remote import tries
from tests.for_each import for_each
from tests.http_server import Fault, Site, serve
from tests.train.kit import TINY_MODEL, Heard, Killed, flip_a_bit, tiny_run, trained
from tests.train.toy import write_toy_dataset
from train.loop.checkpoints import read_checkpoint
from train.progress import TrainProgress
from train.resume import StartOptions
from train.settings import LossSettings


def test_a_second_stage_begins_with_the_first(dataset: Dataset, tmp_path: Path) -> None:
    """With its configuration, whatever the run's own says, and resumes without naming it."""
    first = dataclasses.replace(TINY_MODEL, hidden_width=64)
    trained(tiny_run(model=first, num_steps=4), dataset, tmp_path / "first")
    second = tiny_run(from_weights=True, learning_rate=1e-12, warmup_steps=0, num_steps=4)
    place = str(tmp_path / "first")
    trained(second, dataset, tmp_path / "second", start=StartOptions(begin_with=place))
    before, after = (open_network(tmp_path / name) for name in ("first", "second"))
    assert after.config == first
    for name, weight in after.state_dict().items():
        # a learning rate of 1e-12 moves nothing that float32 shows but numbers near 0
        torch.testing.assert_close(weight, before.state_dict()[name], rtol=1e-6, atol=1e-10)
    trained(second, dataset, tmp_path / "second", resume=True)
    with pytest.raises(TrilightError, match="weights, and none are named; expected begin_with"):
        trained(second, dataset, tmp_path / "third")
    with pytest.raises(TrilightError, match="or --set from_weights=true to begin with those"):
        trained(tiny_run(), dataset, tmp_path / "third", start=StartOptions(begin_with=place))
    with pytest.raises(TrilightError, match="no such file or folder"):
        trained(
            second,
            dataset,
            tmp_path / "third",
            start=StartOptions(begin_with=str(tmp_path / "none")),
        )


def test_a_run_without_the_weights_it_asks_for_does_not_begin(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("TRILIGHT_LPIPS", raising=False)
    with pytest.raises(TrilightError, match="--set loss.perceptual=ms_ssim or none"):
        trained(tiny_run(loss=LossSettings(perceptual="lpips")), dataset, tmp_path)
    assert not list(tmp_path.iterdir())
    other = tiny_run(loss=LossSettings(perceptual="ms_ssim"), num_steps=3)
    trained(other, dataset, tmp_path)


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
        trained(dead, dataset, tmp_path / "dead")
    assert saved_steps((tmp_path / "dead") / "checkpoints") == [52]
    trained(dead, dataset, tmp_path / "dead", resume=True)
    trained(small, dataset, tmp_path / "alive")


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
    out = tmp_path / "stopped"
    whole = trained(settings, dataset, tmp_path / "whole")
    for step in (1, 2, 3):
        with pytest.raises(TrilightError, match=f"stopped at step {step} "):
            trained(settings, dataset, out, resume=step > 1, progress=StopAfterEachStep())
    again = trained(settings, dataset, out, resume=True)
    assert again.folder.weights.read_bytes() == whole.folder.weights.read_bytes()


def test_a_run_goes_on_past_a_damaged_checkpoint_to_the_same_weights(
    dataset: Dataset, tmp_path: Path
) -> None:
    settings = tiny_run(num_steps=8, checkpoints_kept=3)
    whole = trained(settings, dataset, tmp_path)
    weights, path = whole.folder.weights.read_bytes(), path_of_step(whole.folder.checkpoints, 8)
    flip_a_bit(path)
    with pytest.raises(TrilightError, match=f"{path} is not readable"):
        open_network(path)
    notes = Heard()
    again = trained(settings, dataset, tmp_path, resume=True, workers=1, progress=notes)
    assert [str(path) in text for text in notes.notes] == [True]
    assert again.folder.weights.read_bytes() == weights
    assert open_network(path).config == settings.model, "it was written again"


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
    result = trained(settings, dataset, tmp_path)
    # 0.80 and 0.88 of it with two seeds
    assert result.skipped_steps == 0 and result.loss_at_end < 0.95 * result.loss_at_start


def test_muon_goes_on_in_another_precision_on_another_processor(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = tiny_run(muon_rate=3.0, checkpoints_kept=3)
    have_bfloat16(monkeypatch, True)
    whole = trained(settings, dataset, tmp_path)
    assert json.loads(whole.folder.settings.read_text())["muon_precision"] == "bfloat16"
    weights = open_network(tmp_path).state_dict()
    checkpoints = whole.folder.checkpoints
    path_of_step(checkpoints, 12).unlink()
    begun_at = read_checkpoint(path_of_step(checkpoints, 8)).network().state_dict()
    have_bfloat16(monkeypatch, False)
    notes = Heard()
    trained(settings, dataset, tmp_path, resume=True, workers=1, progress=notes)
    assert ["Muon's products in float32 instead of bfloat16" in text for text in notes.notes] == [1]
    assert read_checkpoint(path_of_step(checkpoints, 12)).header["muon_precision"] == "float32"
    resumed = open_network(tmp_path).state_dict()
    apart = sum((resumed[name] - weights[name]).square().sum() for name in weights)
    way = sum((weights[name] - begun_at[name]).square().sum() for name in weights)
    # measured 0.095: the rounding of four steps, and what gradients then differ; without the
    # memories of the first eight it would be 0.85
    assert 0 < apart < 0.15**2 * way


RUN = tiny_run(num_steps=8, validate_every=8)


@pytest.fixture(scope="module")
def weights(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The weights of the run from the folder, uninterrupted."""
    out = tmp_path_factory.mktemp("whole")
    return trained(RUN, dataset, out).folder.weights.read_bytes()


@pytest.fixture
def server(dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    pytest.importorskip("aiohttp", reason="http needs the package aiohttp")
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setattr(tries, "PAUSE_S", 0.0)
    with serve(dataset.folder.root) as running:
        yield running


def test_a_run_begun_in_a_folder_goes_on_from_a_server(
    dataset: Dataset, weights: bytes, server: Site, tmp_path: Path
) -> None:
    """In the middle of an epoch, over a bad line, with another number of threads."""
    out = tmp_path / "out"
    with pytest.raises(Killed):
        trained(RUN, dataset, out, progress=Heard(killed_at=5))
    faults = [Fault(status=503), Fault(cut_after=5000), Fault(flip=True)]
    server.faults = {f"/train-{number:06d}.tar": list(faults) for number in range(3)}
    result = trained(RUN, [server.url], out, resume=True, workers=3)
    assert result.folder.weights.read_bytes() == weights
    assert result.unusable == ()


def test_a_list_gives_the_same_weights_and_says_what_it_lacks(
    dataset: Dataset, weights: bytes, server: Site, tmp_path: Path
) -> None:
    listener = Heard(killed_at=99)
    pattern = f"{server.url}/{{train-000000,train-000001,train-000002,validation-000000}}.tar"
    result = trained(RUN, [pattern], tmp_path / "out", progress=listener)
    # the header alone differs: without a manifest nobody knows how large the scenes may be
    ours, theirs = load(result.folder.weights.read_bytes()), load(weights)
    assert ours.keys() == theirs.keys() and all(torch.equal(ours[n], theirs[n]) for n in ours)
    lacks, *others = listener.notes
    assert lacks == NO_MANIFEST
    assert [note for note in others if "decode" not in note] == []  # how many threads do
    with pytest.raises(TrilightError, match=r"made with list:\w{12}\..* --change data=sha256:"):
        trained(RUN, dataset, tmp_path / "out", resume=True)


def test_the_budget_of_damage_is_the_run_s_and_not_the_process_s(
    dataset: Dataset, tmp_path: Path
) -> None:
    """Damage that was met before a stop counts after it, though it is whole again by then."""
    root, out = tmp_path / "damaged", tmp_path / "out"
    copied = write_toy_dataset(root, train=7, validation=2, per_shard=3)
    first, second = (copied.folder.shard(f"train-00000{number}.tar") for number in range(2))
    settings = dataclasses.replace(RUN, most_unusable=3)
    flip_a_bit(first)
    with pytest.raises(Killed):
        trained(settings, [str(root)], out, progress=Heard(killed_at=5))
    flip_a_bit(first)  # whole again
    flip_a_bit(second)
    with pytest.raises(TrilightError, match="6 samples are unusable; expected at most 3"):
        trained(settings, [str(root)], out, resume=True)
    flip_a_bit(second)
    flip_a_bit(first)
    assert len(trained(settings, [str(root)], out, resume=True).unusable) == 1


def test_a_second_trainer_is_refused_and_changes_nothing(dataset: Dataset, tmp_path: Path) -> None:
    """However it begins; who reads the run meanwhile may, and a kill leaves the folder free."""
    out, said = tmp_path / "run", list[str]()

    def files() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}

    class Second(Heard):
        def advance(self, *, step: int, **_: Any) -> None:
            if step == 6:
                before = files()
                for start in (
                    StartOptions(),
                    StartOptions(resume=True),
                    StartOptions(restartable=True),
                    StartOptions(resume=True, decisions={"learning_rate": 1e-5}),
                ):
                    with pytest.raises(TrilightError) as refused:
                        trained(tiny_run(), dataset, out, start=start)
                    said.append(str(refused.value))
                open_network(out)
                assert files() == before
                raise Killed

    with pytest.raises(Killed):
        trained(tiny_run(), dataset, out, progress=Second())
    holder = f"{out}: process {os.getpid()} of {socket.gethostname()}, at it since "
    assert len(said) == 4 and all(text.startswith(holder) for text in said), said
    (out / "train.claim").write_text("as a process leaves it that is killed")
    trained(tiny_run(), dataset, out, resume=True)
    assert not (out / "train.claim").exists()
    with pytest.raises(TrilightError, match="no manifest.json here"):
        trained(tiny_run(), [str(tmp_path / "none")], tmp_path / "a" / "b")
    assert not (tmp_path / "a").exists()
