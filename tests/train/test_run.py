"""Laws of a run: interrupted is uninterrupted, learning is learning, a mistake is one line."""

import json
import os
import re
import shutil
import signal
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from PIL import Image

from model.layers import Norm
from model.weights import TrainedRange, decode_weights, trained_range
from storage.dataset.dataset import Dataset
from storage.errors import TrilightError
from storage.records.safe_read import safetensors_header
from tests.command_line import trilight
from tests.train.kit import Heard, Killed, tiny_run, trained
from tests.train.toy import write_toy_dataset
from train.evaluation import judge
from train.loop import trainer
from train.loop.interrupts import Stopped
from train.monitoring.rows import read_rows
from train.progress import TrainProgress
from train.result import TrainResult
from train.resume import StartOptions

TIMINGS = {"views_per_s", "data_wait_share", "flops_per_s", "peak_share", "time_s", "memory_mb"}


class Listener(Heard):
    """Keeps what a run says of its progress."""

    def __init__(self) -> None:
        super().__init__()
        self.heard: list[str] = []

    def begin(self, *, step: int, num_steps: int, **_: Any) -> None:
        self.heard.append(f"begin {step}/{num_steps}")

    def advance(self, *, step: int, **_: Any) -> None:
        self.heard.append(f"step {step}")

    def report_validation(self, *, step: int, **_: Any) -> None:
        self.heard.append(f"validated {step}")


@pytest.fixture(scope="module")
def listener() -> Listener:
    """What heard of the whole run."""
    return Listener()


@pytest.fixture(scope="module")
def whole(
    dataset: Dataset, listener: Listener, tmp_path_factory: pytest.TempPathFactory
) -> TrainResult:
    """The run that nothing interrupts."""
    return trained(tiny_run(), dataset, tmp_path_factory.mktemp("whole"), progress=listener)


class SignalAt(TrainProgress):
    """A person who presses Ctrl-C, or a scheduler that sends SIGTERM."""

    def __init__(self, step: int, number: int) -> None:
        self.step = step
        self.number = number

    def advance(self, *, step: int, **_: Any) -> None:
        if step == self.step:
            os.kill(os.getpid(), self.number)


def same_as_uninterrupted(out: Path, whole: TrainResult) -> None:
    last = f"checkpoints/step-{whole.num_steps:09d}.safetensors"
    for name in ("model.safetensors", last, "validation_sheet.png"):
        assert (out / name).read_bytes() == (whole.folder.root / name).read_bytes(), name


def curve(out: Path) -> list[dict]:
    rows = read_rows(out / "metrics.jsonl")
    return [{k: v for k, v in row.items() if k not in TIMINGS} for row in rows]


def test_stopped_and_resumed_is_uninterrupted_to_the_bit(
    dataset: Dataset, whole: TrainResult, tmp_path: Path
) -> None:
    """By each signal in turn, in the middle of rows of the log."""
    handlers = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    for step, number in ((1, signal.SIGINT), (7, signal.SIGTERM), (11, signal.SIGUSR1)):
        with pytest.raises(TrilightError, match=f"stopped at step {step} .* --resume"):
            trained(tiny_run(), dataset, tmp_path, resume=step > 1, progress=SignalAt(step, number))
        assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == handlers
    trained(tiny_run(), dataset, tmp_path, resume=True)
    same_as_uninterrupted(tmp_path, whole)
    assert curve(tmp_path) == curve(whole.folder.root), "a row half full is filled"


class SignalIn:
    """A signal within a call of a function of another module, after which that goes on."""

    def __init__(self, patch: pytest.MonkeyPatch, module: ModuleType, name: str, call: int) -> None:
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
        # one call for the median picture, and one for each of two scenes
        (judge, "score_pictures", 2, 8),
        # two scenes of step 8 that are made up for, and the first of the last step
        (judge, "predict", 3, 12),
        # the last scene of the last step, which is made up for
        (judge, "predict", 2, 12),
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
    same_as_uninterrupted(tmp_path, whole)
    assert curve(tmp_path) == curve(whole.folder.root)


def test_the_same_command_begins_begins_again_and_goes_on(
    dataset: Dataset, whole: TrainResult, tmp_path: Path
) -> None:
    """As a scheduler starts it: killed before the first checkpoint, and after one."""
    start = StartOptions(restartable=True)
    for step in (3, 7):
        with pytest.raises(Killed):
            trained(tiny_run(), dataset, tmp_path, start=start, progress=Heard(killed_at=step))
    trained(tiny_run(), dataset, tmp_path, start=start)
    same_as_uninterrupted(tmp_path, whole)
    assert curve(tmp_path) == curve(whole.folder.root)
    begun = [row["text"].split(" on ")[0] for row in read_rows(tmp_path / "notes.jsonl")]
    assert [text for text in begun if text in ("began", "went")] == ["began", "began", "went"]


def test_a_finished_run_is_judged_again(
    dataset: Dataset, whole: TrainResult, tmp_path: Path
) -> None:
    shutil.copytree(whole.folder.root, tmp_path, dirs_exist_ok=True)
    (tmp_path / "validation_sheet.png").unlink()
    again = trained(tiny_run(), dataset, tmp_path, resume=True)
    assert again.scores == whole.scores
    same_as_uninterrupted(tmp_path, whole)


def test_the_folder_holds_everything_and_agrees_with_the_result(
    whole: TrainResult, listener: Listener
) -> None:
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
    weights = folder.weights.read_bytes()
    assert trained_range(safetensors_header(weights)["__metadata__"]) == TrainedRange(
        max_triangles=64,  # of the manifest of the toy dataset
        resolution=16,
    )
    model = decode_weights(weights)
    assert sum(weight.numel() for weight in model.parameters()) == whole.num_parameters

    steps = [f"step {step}" for step in range(1, 13)]
    for step in (12, 8, 4):
        steps.insert(step, f"validated {step}")
    assert listener.heard == ["begin 0/12", *steps]


def test_mistakes_are_named(dataset: Dataset, whole: TrainResult, tmp_path: Path) -> None:
    with pytest.raises(TrilightError, match="resolution 24: expected a divisor of 32"):
        trained(tiny_run(resolution=24), dataset, tmp_path / "b")
    with pytest.raises(TrilightError, match="views_per_scene is 3, .* have 2 views"):
        trained(tiny_run(views_per_scene=3), dataset, tmp_path / "c")
    with pytest.raises(TrilightError, match="holds a run already; add --resume"):
        trained(tiny_run(), dataset, whole.folder.root)


def test_data_without_a_validation_split_trains_and_says_so(
    dataset: Dataset, whole: TrainResult, tmp_path: Path
) -> None:
    """As the first eight scenes of a new user; the steps are those of any other run."""
    few = write_toy_dataset(tmp_path / "data", train=7, validation=0, per_shard=3)
    out, listener = tmp_path / "out", Listener()
    result = trained(tiny_run(), few, out, progress=listener)
    note, workers = listener.notes
    assert "decode" in workers and "cores" in workers, "the default of --workers is said"
    assert "no validation split" in note and "more scenes" in note
    assert not [text for text in listener.heard if text.startswith("validated")]
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
    done = trilight(["evaluate", str(out), *data, "--out", str(tmp_path / "page")])
    assert done.exit_code == 0, done.output


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


def test_an_empty_training_split_is_named(tmp_path: Path) -> None:
    dataset = write_toy_dataset(tmp_path / "data", resolution=8, train=0, validation=1)
    with pytest.raises(TrilightError, match="the train split holds no scene"):
        trained(tiny_run(resolution=8), dataset, tmp_path / "out")
