"""Laws of a run: interrupted is uninterrupted, learning is learning, a mistake is one line.

How and where runs begin: from given weights, with the term that was asked for, and not dead. A run
from a server, or from a list, is the run from the folder.
"""

import dataclasses
import json
import os
import re
import shutil
import signal
import socket
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image
from safetensors.torch import load

from model.layers import Norm
from model.open import find_network, open_network, path_of_step, saved_steps
from model.weights import TrainedRange
from storage.dataset.dataset import Dataset
from storage.dataset.training_data import NO_MANIFEST
from storage.errors import TrilightError
from storage.remote import transfers
from tests.command_line import expect_output
from tests.for_each import for_each
from tests.http_server import Fault, serve
from tests.train.kit import (
    TINY_MODEL,
    Heard,
    Killed,
    apart,
    flip_a_bit,
    require_same_run,
    tiny_run,
    trained,
)
from tests.train.toy import write_toy_dataset
from train.evaluation import validation
from train.folder import read_rows
from train.loop import trainer
from train.loop.checkpoints import read_checkpoint
from train.loop.interrupts import SIGNALS, Stopped
from train.progress import TrainProgress
from train.run_training import TrainResult
from train.settings import LossSettings

HEARD = Heard()
"""Of the whole run."""


@pytest.fixture(scope="module")
def whole(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> TrainResult:
    """The run that nothing interrupts."""
    return trained(tiny_run(), dataset, tmp_path_factory.mktemp("whole"), progress=HEARD)


class SignalAt(TrainProgress):
    """A person who presses Ctrl-C, or a scheduler that sends SIGTERM."""

    def __init__(self, step: int, number: int) -> None:
        self.step = step
        self.number = number

    def advance(self, *, step: int, **_: Any) -> None:
        if step == self.step:
            os.kill(os.getpid(), self.number)


class SignalIn:
    """A signal within a call of a function of another module, after which that goes on."""

    def __init__(self, patch: pytest.MonkeyPatch, module: object, name: str, call: int) -> None:
        function, self.calls = getattr(module, name), 0

        def asked(*given: object, **named: object) -> object:
            self.calls += 1
            if self.calls == call:
                os.kill(os.getpid(), signal.SIGUSR1)
            return function(*given, **named)

        patch.setattr(module, name, asked)


def test_a_signal_in_a_validation_or_while_saving_loses_nothing(
    dataset: Dataset, whole: TrainResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A validation that was left is not finished first; the resumed run makes up for it."""
    for number, (module, name, call, step) in enumerate((
        (trainer, "save_checkpoint", 1, 4),
        # a call for the median picture of each of two scenes, and one for each scene
        (validation.ValidationScene, "scores", 3, 8),
        # two scenes of step 8 that are made up for, and the first of the last step
        (validation, "predict", 3, 12),
        # the last scene of the last step, which is made up for
        (validation, "predict", 2, 12),
    )):  # fmt: skip
        with monkeypatch.context() as patch:
            asked = SignalIn(patch, module, name, call)
            with pytest.raises(Stopped, match=f"stopped at step {step} by") as stopped:
                trained(tiny_run(), dataset, tmp_path, resume=number > 0)
        assert (asked.calls, stopped.value.exit_status) == (call, 75), number
        rows = read_rows(tmp_path / "metrics.jsonl")
        left = [row["step"] for row in rows if "validation" in row]
        assert (step in left) == (name == "save_checkpoint"), number
    trained(tiny_run(), dataset, tmp_path, resume=True)
    require_same_run(tmp_path, whole.folder.root)


def test_the_same_command_begins_begins_again_and_goes_on(
    dataset: Dataset, whole: TrainResult, tmp_path: Path
) -> None:
    """As a scheduler starts it: killed before the first checkpoint, and after one."""
    again: dict[str, Any] = {"restartable": True}
    for step in (3, 7):
        with pytest.raises(Killed):
            trained(tiny_run(), dataset, tmp_path, **again, progress=Heard(killed_at=step))
    trained(tiny_run(), dataset, tmp_path, **again)
    require_same_run(tmp_path, whole.folder.root)
    begun = [row["text"].split(" on ")[0] for row in read_rows(tmp_path / "notes.jsonl")]
    assert [text for text in begun if text in ("began", "went")] == ["began", "began", "went"]


def test_a_finished_run_is_judged_again(
    dataset: Dataset, whole: TrainResult, tmp_path: Path
) -> None:
    shutil.copytree(whole.folder.root, tmp_path, dirs_exist_ok=True)
    (tmp_path / "validation_sheet.png").unlink()
    again = trained(tiny_run(), dataset, tmp_path, resume=True)
    assert again.scores == whole.scores
    require_same_run(tmp_path, whole.folder.root)


def test_the_folder_holds_everything_and_agrees_with_the_result(whole: TrainResult) -> None:
    """And progress hears of every step."""
    folder = whole.folder
    summary = json.loads(folder.summary.read_text())
    assert summary["scores"] == whole.scores
    assert summary["median_scores"] == whole.median_scores
    assert summary["beats_median"] == whole.beats_median
    settings = json.loads(folder.settings.read_text())
    assert settings["settings"]["num_steps"] == whole.num_steps == 12
    rows = read_rows(folder.metrics)
    assert [row["step"] for row in rows if "loss" in row] == [2, 4, 6, 8, 10, 12]
    assert [row["step"] for row in rows if "validation" in row] == [4, 8, 12]
    assert rows[-1]["validation"] == whole.scores
    with Image.open(folder.sheet) as sheet:
        assert min(sheet.size) > 200
    assert find_network(folder.weights).trained == TrainedRange(
        max_triangles=64,  # of the manifest of the toy dataset
        resolution=16,
    )
    model = open_network(folder.weights)
    assert sum(weight.numel() for weight in model.parameters()) == whole.num_parameters

    steps = [f"step {step}" for step in range(1, 13)]
    for step in (12, 8, 4):
        steps.insert(step, f"validated {step}")
    assert HEARD.progress == ["begin 0/12", *steps]


def test_mistakes_are_named(
    dataset: Dataset, whole: TrainResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(TrilightError, match="resolution 24: expected a divisor of 32"):
        trained(tiny_run(resolution=24), dataset, tmp_path / "b")
    with pytest.raises(TrilightError, match="views_per_scene is 3, .* have 2 views"):
        trained(tiny_run(views_per_scene=3), dataset, tmp_path / "c")
    with pytest.raises(TrilightError, match="holds a run already; add --resume"):
        trained(tiny_run(), dataset, whole.folder.root)
    empty = write_toy_dataset(tmp_path / "data", resolution=8, train=0, validation=1)
    with pytest.raises(TrilightError, match="the train split holds no scene"):
        trained(tiny_run(resolution=8), empty, tmp_path / "d")
    monkeypatch.delenv("TRILIGHT_LPIPS", raising=False)
    with pytest.raises(TrilightError, match="--set loss.perceptual=ms_ssim or none"):
        trained(tiny_run(loss=LossSettings(perceptual="lpips")), dataset, tmp_path / "e")
    assert not list(tmp_path.glob("e/*"))
    other = tiny_run(loss=LossSettings(perceptual="ms_ssim"), num_steps=3)
    trained(other, dataset, tmp_path / "e")


def test_data_without_a_validation_split_trains_and_says_so(
    dataset: Dataset, whole: TrainResult, tmp_path: Path
) -> None:
    """As the first eight scenes of a new user; the steps are those of any other run."""
    few = write_toy_dataset(tmp_path / "data", train=7, validation=0, per_shard=3)
    out, listener = tmp_path / "out", Heard()
    result = trained(tiny_run(), few, out, progress=listener)
    note, workers = listener.notes
    assert "decode" in workers and "cores" in workers, "the default of --workers is said"
    assert "no validation split" in note and "more scenes" in note
    assert not [text for text in listener.progress if text.startswith("validated")]
    assert (result.scores, result.median_scores, result.beats_median) == (None, None, None)
    summary = json.loads(result.folder.summary.read_text())
    assert summary["scores"] is summary["beats_median"] is summary["lead"] is None
    assert not result.folder.sheet.exists()
    assert not [row for row in read_rows(result.folder.metrics) if "validation" in row]
    weights = whole.folder.weights.read_bytes()
    assert result.folder.weights.read_bytes() == weights
    again = trained(tiny_run(), few, out, resume=True)
    assert again.folder.weights.read_bytes() == weights
    data = ["--data", str(dataset.folder.root), "--split", "validation", "--most-scenes", "1"]
    data += ["--tracer-views", "0"]
    expect_output("evaluate", out, *data, "--out", tmp_path / "page")


class Poison(Heard):
    """Makes every norm return NaN in all steps after the first but those in `spared`."""

    def __init__(self, spared: set[int], monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__()
        self.spared, self.poisoned = spared, False
        original = Norm.forward

        def forward(module: Norm, x: torch.Tensor) -> torch.Tensor:
            return original(module, x) * (torch.nan if self.poisoned else 1)

        monkeypatch.setattr(Norm, "forward", forward)

    def advance(self, *, step: int, **_: Any) -> None:
        self.poisoned = step + 1 not in self.spared


def test_a_run_that_recovers_goes_on_and_counts(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nine steps fail, one is taken, nine fail; of ten in a row see test_ways_on."""
    poison = Poison({11, 21}, monkeypatch)
    settings = tiny_run(num_steps=21, validate_every=22, scenes_per_step=2)
    result = trained(settings, dataset, tmp_path, progress=poison)
    assert result.skipped_steps == 18
    named = [re.search(r"step (\d+) was skipped.* scenes were 0+\d+, ", n) for n in poison.notes]
    assert [int(match[1]) for match in named if match] == [*range(2, 11), *range(12, 21)]
    losses = {row["step"]: row["loss"] for row in read_rows(result.folder.metrics) if "loss" in row}
    assert losses[4] is None and losses[12] > 0, "a row without a finite step has no loss"


def test_a_second_stage_begins_with_the_first(dataset: Dataset, tmp_path: Path) -> None:
    """With its configuration, whatever the run's own says, and resumes without naming it."""
    first = dataclasses.replace(TINY_MODEL, hidden_width=64)
    trained(tiny_run(model=first, num_steps=4), dataset, tmp_path / "first")
    second = tiny_run(from_weights=True, learning_rate=1e-12, warmup_steps=0, num_steps=4)
    place = str(tmp_path / "first")
    result = trained(second, dataset, tmp_path / "second", begin_with=place)
    (event,) = result.history
    digest = json.loads(result.folder.settings.read_text())["begun_with_sha256"]
    assert event.after == {"run": "tiny", "step": 4, "sha256": digest}
    before, after = (open_network(tmp_path / name) for name in ("first", "second"))
    assert after.config == first
    for name, weight in after.state_dict().items():
        # a learning rate of 1e-12 moves nothing that float32 shows but numbers near 0
        torch.testing.assert_close(weight, before.state_dict()[name], rtol=1e-6, atol=1e-10)
    trained(second, dataset, tmp_path / "second", resume=True)
    with pytest.raises(TrilightError, match="weights, and none are named; expected begin_with"):
        trained(second, dataset, tmp_path / "third")
    with pytest.raises(TrilightError, match="or --set from_weights=true to begin with those"):
        trained(tiny_run(), dataset, tmp_path / "third", begin_with=place)
    with pytest.raises(TrilightError, match="no such file or folder"):
        trained(second, dataset, tmp_path / "third", begin_with=f"{place}/no")


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


@for_each("muon_rate, quick", [(0.0, True), (3.0, True), (3.0, False)])
def test_stopped_by_each_signal_and_resumed_is_uninterrupted_to_the_bit(
    dataset: Dataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    muon_rate: float,
    quick: bool,
) -> None:
    """After every step, also within rows of the log: a row half full is filled.

    With a running mean, every symmetry that toy scenes have, and a perceptual term.
    """
    have_bfloat16(monkeypatch, quick)
    settings = tiny_run(
        num_steps=4,
        ema_decay=0.9,
        muon_rate=muon_rate,
        loss=LossSettings(perceptual="ms_ssim", noise_half=0.01),
    )
    out = tmp_path / "stopped"
    whole = trained(settings, dataset, tmp_path / "whole")
    handlers = [signal.getsignal(number) for number in SIGNALS]
    for step, number in enumerate(SIGNALS, 1):
        with pytest.raises(TrilightError, match=f"stopped at step {step} .* --resume"):
            trained(settings, dataset, out, resume=step > 1, progress=SignalAt(step, number))
        assert [signal.getsignal(number) for number in SIGNALS] == handlers
    trained(settings, dataset, out, resume=True)
    require_same_run(out, whole.folder.root)


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
    # measured 0.095: the rounding of four steps, and what gradients then differ; without the
    # memories of the first eight it would be 0.85
    away = apart(weights, open_network(tmp_path).state_dict())
    assert 0 < away < 0.15 * apart(weights, begun_at)


RUN = tiny_run(num_steps=8, validate_every=8)


def test_a_server_and_a_list_give_the_weights_of_the_folder(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Begun in the folder, in the middle of an epoch, over a bad line, with other threads.

    The list says what it lacks.
    """
    pytest.importorskip("aiohttp", reason="http needs the package aiohttp")
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setattr(transfers, "PAUSE_S", 0.0)
    expected = trained(RUN, dataset, tmp_path / "whole").folder.weights.read_bytes()
    out, listed, listener = tmp_path / "out", tmp_path / "listed", Heard()
    with pytest.raises(Killed):
        trained(RUN, dataset, out, progress=Heard(killed_at=5))
    faults = [Fault(status=503), Fault(cut_after=5000), Fault(flip=True)]
    with serve(dataset.folder.root) as server:
        server.faults = {f"/train-{number:06d}.tar": list(faults) for number in range(3)}
        monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
        result = trained(RUN, [server.url], out, resume=True, workers=3)
        assert result.folder.weights.read_bytes() == expected
        assert result.unusable == ()
        server.faults = {}
        monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "another cache"))
        pattern = f"{server.url}/{{train-000000,train-000001,train-000002,validation-000000}}.tar"
        result = trained(RUN, [pattern], listed, progress=listener)
    # the header alone differs: without a manifest nobody knows how large the scenes may be
    ours, theirs = load(result.folder.weights.read_bytes()), load(expected)
    assert ours.keys() == theirs.keys() and all(torch.equal(ours[n], theirs[n]) for n in ours)
    lacks, *others = listener.notes
    assert lacks == NO_MANIFEST
    assert [note for note in others if "decode" not in note] == []  # how many threads do
    with pytest.raises(TrilightError, match=r"made with list:\w{12}\..* --change data=sha256:"):
        trained(RUN, dataset, listed, resume=True)


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
                end = time.monotonic() + 60
                while not saved_steps(out / "checkpoints") and time.monotonic() < end:
                    time.sleep(0.01)  # it is written in the background
                before = files()
                start: dict[str, Any]
                for start in (
                    {},
                    {"resume": True},
                    {"restartable": True},
                    {"resume": True, "decisions": {"learning_rate": 1e-5}},
                ):
                    with pytest.raises(TrilightError) as refused:
                        trained(tiny_run(), dataset, out, **start)
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
    with pytest.raises(TrilightError, match="none: no such folder"):
        trained(tiny_run(), [str(tmp_path / "none")], tmp_path / "a" / "b")
    assert not (tmp_path / "a").exists()
