"""Every way on of docs/how-to/carry-on-a-run.md, tried: what stopped a run, and what goes on."""

import dataclasses
import json
import math
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from model.open import open_network, path_of_step, saved_steps
from storage.dataset.dataset import Dataset, open_dataset
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.train.data.test_bad_samples import BAD_KEY, spoil_sample
from tests.train.kit import Heard, Killed, tiny_run, trained
from tests.train.toy import write_toy_dataset
from train import run_training as run_module
from train.data.buckets import TrainingBatch
from train.folder import RunFolder
from train.loop import step as step_module
from train.loop.checkpoints import read_checkpoint
from train.loop.recorder import read_rows
from train.loop.step import PendingStats, Stepper
from train.progress import TrainProgress
from train.resume import StartOptions
from train.run_training import TrainResult
from train.settings import TrainSettings


def run(
    settings: TrainSettings,
    data: Dataset,
    out: Path,
    *,
    progress: TrainProgress | None = None,
    **start: Any,
) -> TrainResult:
    return trained(settings, data, out, start=StartOptions(**start), progress=progress)


def wsd(**changes: Any) -> TrainSettings:
    """Return a run with a constant rate, and none of the things that only take time here."""
    few = {
        "schedule": "wsd",
        "ema_decay": 0.9,
        "num_steps": 5,
        "warmup_steps": 1,
        "log_every": 1,
        "validate_every": 1000,
        "checkpoint_every": 4,
        "validation_scenes": 1,
    }
    return tiny_run(**(few | changes))


def weights(place: Path) -> dict[str, Tensor]:
    return open_network(place).state_dict()


def same(one: dict[str, Tensor], other: dict[str, Tensor]) -> bool:
    return all(torch.equal(one[name], other[name]) for name in one)


def apart(one: dict[str, Tensor], other: dict[str, Tensor]) -> float:
    """Return how far two networks are apart, root of the sum of squares."""
    return sum(float((one[name] - other[name]).square().sum()) for name in one) ** 0.5


SHORT = wsd(checkpoints_kept=1, checkpoint_every=3)


@pytest.fixture(scope="module")
def short(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A finished run of five steps whose rate falls after the fourth; to be copied."""
    return run(SHORT, dataset, tmp_path_factory.mktemp("short")).folder


def test_an_extended_run_is_a_longer_one_to_the_bit(
    dataset: Dataset, short: RunFolder, tmp_path: Path
) -> None:
    """From where the short one's decay begins, which is kept for it; and the short one is whole."""
    long = run(wsd(num_steps=10), dataset, tmp_path / "long")
    assert saved_steps(short.checkpoints) == [4, 5]
    begins = path_of_step(short.checkpoints, 4)
    whole = read_checkpoint(path_of_step(long.folder.checkpoints, 8)).arrays
    start: dict[str, Any] = {"branch": str(begins), "decisions": {"num_steps": 10}}
    extended = run(SHORT, dataset, tmp_path / "extended", **start)
    ours = read_checkpoint(path_of_step(extended.folder.checkpoints, 8)).arrays
    assert ours.keys() == whole.keys()
    assert all((ours[name] == whole[name]).all() for name in whole), "weights, mean and memories"
    # it decays where the longer one does, so the rest is the same too
    assert extended.folder.weights.read_bytes() == long.folder.weights.read_bytes()
    assert short.weights.read_bytes() != long.folder.weights.read_bytes()
    logs = [read_rows(each.folder.metrics) for each in (extended, long)]
    losses = [[(row["step"], row.get("loss")) for row in rows if "loss" in row] for rows in logs]
    assert losses[0] == losses[1], "the branch has the log of the run that it left"
    assert [(event.kind, event.name) for event in extended.history] == [
        ("meaning", "num_steps"),
        ("origin", "checkpoint"),
    ]
    assert extended.history[1].after == {
        "run": "tiny",
        "step": 4,
        "sha256": read_checkpoint(begins).header["sha256"],
    }


def test_a_finished_run_made_longer_in_its_own_folder(
    dataset: Dataset, short: RunFolder, tmp_path: Path
) -> None:
    """Its rate rises again, which is said; the decision is on disk, in the summary, and stays."""
    shutil.copytree(short.root, tmp_path, dirs_exist_ok=True)
    with pytest.raises(TrilightError, match="num_steps is 7, but the checkpoint was made with 5"):
        run(dataclasses.replace(SHORT, num_steps=7), dataset, tmp_path, resume=True)
    notes = Heard()
    longer = run(SHORT, dataset, tmp_path, resume=True, decisions={"num_steps": 7}, progress=notes)
    assert longer.num_steps == 7
    assert any("the rate had been falling since step 4" in text for text in notes.notes)
    recorded = {"step": 5, "kind": "meaning", "name": "num_steps", "before": 5, "after": 7}
    record = json.loads(longer.folder.settings.read_text())
    assert record["settings"]["num_steps"] == 7 and record["history"] == [recorded]
    assert json.loads(longer.folder.summary.read_text())["history"] == [recorded]
    again = run(SHORT, dataset, tmp_path, resume=True)
    assert again.num_steps == 7, "the command that began it goes on with what was decided"


def test_a_kill_forgets_no_decision(dataset: Dataset, short: RunFolder, tmp_path: Path) -> None:
    shutil.copytree(short.root, tmp_path, dirs_exist_ok=True)
    path_of_step(tmp_path / "checkpoints", 5).unlink()
    with pytest.raises(Killed):
        run(
            SHORT,
            dataset,
            tmp_path,
            resume=True,
            decisions={"seed": 5},
            progress=Heard(killed_at=5),
        )
    again = run(SHORT, dataset, tmp_path, resume=True)
    assert [(event.step, event.name, event.after) for event in again.history] == [(4, "seed", 5)]


def test_too_little_memory_goes_on_with_fewer_scenes_a_pass(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = wsd(num_steps=6, scenes_per_step=4, checkpoint_every=2, checkpoints_kept=9)
    run(settings, dataset, tmp_path / "whole")
    original, steps = step_module.predict_log10, [0]

    def small_card(net: Any, batch: TrainingBatch, *rest: Any) -> Tensor:
        steps[0] += 1
        if steps[0] > 6 and len(batch.target_BVRR3) > 1:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return original(net, batch, *rest)

    monkeypatch.setattr(step_module, "predict_log10", small_card)
    with pytest.raises(TrilightError, match=r"too little memory in step \d+.*scenes_per_pass=2"):
        run(settings, dataset, tmp_path / "small")
    notes, step = Heard(), saved_steps(tmp_path / "small/checkpoints")[-1]
    one = dataclasses.replace(settings, scenes_per_pass=1)
    run(one, dataset, tmp_path / "small", resume=True, progress=notes)
    assert any("scenes_per_pass is 1 instead of 16" in text for text in notes.notes)
    found, wanted = weights(tmp_path / "small"), weights(tmp_path / "whole")
    before = read_checkpoint(path_of_step(tmp_path / "small/checkpoints", step)).network()
    way = apart(wanted, before.state_dict())
    # float32 sums in another order: measured 9e-7 of the way since then
    assert 0 < apart(found, wanted) < 1e-5 * way


def test_a_bad_sample_is_left_out_by_its_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Met in the middle of a run: the median picture would have met it before the first step."""
    monkeypatch.setattr(run_module, "MEDIAN_SCENES", 1)
    data = write_toy_dataset(tmp_path / "data", train=8, validation=1, per_shard=2, resolution=8)
    spoil_sample(data)
    data = open_dataset(str(data.folder.root))
    each = {
        "resolution": 8,
        "num_steps": 8,
        "scenes_per_step": 1,
        "checkpoint_every": 1,
        "log_every": 1,
    }
    with pytest.raises(TrilightError, match=rf"sample {BAD_KEY}: .*OpenEXR.* --skip-unusable"):
        run(wsd(**each), data, tmp_path / "out")
    stopped_at = saved_steps(tmp_path / "out/checkpoints")[-1]
    assert 0 < stopped_at < 8
    notes = Heard()
    allowed = wsd(**each, most_unusable=1)
    result = run(allowed, data, tmp_path / "out", resume=True, progress=notes)
    assert sum(text.startswith("left out: ") and BAD_KEY in text for text in notes.notes) == 1
    assert BAD_KEY in result.unusable[0] and result.num_steps == 8
    assert BAD_KEY in result.folder.summary.read_text()
    (event,) = result.history
    assert (event.step, event.name, event.after) == (stopped_at, "most_unusable", 1)


def test_ten_skipped_steps_go_on_by_a_decision(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the folder, or, where the weights themselves are lost, from an earlier checkpoint.

    Resumed as it is, it ends at the same step again: the row of skipped steps is remembered.
    """
    settings = wsd(num_steps=16, keep_every=2, checkpoint_every=2)

    original = Stepper.launch

    def diverging(self: Stepper, *given: Any, **rest: Any) -> PendingStats:
        now = self._settings
        if self._state.step >= 4 and (now.learning_rate, now.seed) == (2e-3, 0):
            return torch.tensor([math.nan, math.nan, 0.0, 0.0, math.nan, 0.0, 0.0]).double()
        return original(self, *given, **rest)

    monkeypatch.setattr(Stepper, "launch", diverging)
    ways = r"10 steps in a row up to step 14.*--change learning_rate=0\.001.*seed=1.*--branch"
    for again in (False, True):
        with pytest.raises(TrilightError, match=ways):
            run(settings, dataset, tmp_path / "run", resume=again)
    slower = {"learning_rate": 1e-3}
    in_place = run(settings, dataset, tmp_path / "run", resume=True, decisions=slower)
    assert in_place.num_steps == 16
    early = str(path_of_step(tmp_path / "run/checkpoints", 2))
    rewound = run(settings, dataset, tmp_path / "branch", branch=early, decisions={"seed": 1})
    assert rewound.skipped_steps == 0
    assert [event.step for event in rewound.history] == [2, 2]


def test_a_branch_takes_other_data_and_other_pictures(dataset: Dataset, tmp_path: Path) -> None:
    """With the optimiser's memories, at the steps of the run; a running mean may begin, too."""
    run(wsd(ema_decay=0.0), dataset, tmp_path / "first")
    other = write_toy_dataset(tmp_path / "data", train=5, validation=1, per_shard=3)
    digest = f"sha256:{other.digest[:12]}"
    stage = {"data": digest, "resolution": 32, "num_steps": 6, "ema_decay": 0.5}
    branch = str(tmp_path / "first")
    with pytest.raises(TrilightError, match=f"--change data={digest}"):
        run(wsd(ema_decay=0.0), other, tmp_path / "second", branch=branch)
    assert not (tmp_path / "second").exists()
    out = tmp_path / "second"
    start: dict[str, Any] = {"branch": branch, "decisions": stage}
    result = run(wsd(ema_decay=0.0), other, out, **start)
    assert result.num_steps == 6
    assert {event.name for event in result.history} == {*stage, "checkpoint"}
    assert open_network(out).config == wsd().model
    with pytest.raises(TrilightError, match="holds a run already; add --resume"):
        run(wsd(ema_decay=0.0), other, out, **start)
    again = run(wsd(ema_decay=0.0), other, out, resume=True, **start)
    assert again.history == result.history, "the same command with --resume, as it is printed"


def test_what_is_decided_is_done(dataset: Dataset, tmp_path: Path) -> None:
    """By the stream, the loss, the update: none of them still reads what the command states."""
    settings = wsd(ema_decay=0.0)
    run(settings, dataset, tmp_path / "whole")
    branch = str(path_of_step(tmp_path / "whole/checkpoints", 4))
    for name, value in {
        "seed": 3,
        "views_per_scene": 1,
        "augmentation.rotation": "uniform",
        "loss.perceptual": "ms_ssim",
        "weight_decay": 1.0,
        "learning_rate": 1e-3,
    }.items():
        out = tmp_path / name
        run(settings, dataset, out, branch=branch, decisions={name: value})
        assert not same(weights(out), weights(tmp_path / "whole")), name
    run(settings, dataset, tmp_path / "as it was", branch=branch)
    assert same(weights(tmp_path / "as it was"), weights(tmp_path / "whole"))


@for_each(
    ("start", "message"),
    [
        ({"decisions": {"seed": 1}}, "has not begun, so --change seed changes nothing"),
        ({"branch": "a", "begin_with": "b"}, "branch is a and begin_with is b; expected one"),
        ({"branch": "nowhere.safetensors"}, "checkpoint nowhere.safetensors is not readable"),
    ],
)
def test_a_start_that_is_none_is_refused(
    dataset: Dataset, tmp_path: Path, start: dict[str, Any], message: str
) -> None:
    with pytest.raises(TrilightError, match=message):
        run(wsd(), dataset, tmp_path / "out", **start)
