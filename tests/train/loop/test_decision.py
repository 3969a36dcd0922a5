"""A decision that only kernels know does what one of the host does; here on a processor."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.for_each import for_each
from tests.train.kit import tiny_run, trained
from tests.train.loop.test_optim import with_gradients
from tests.train.toy import toy_sample, write_toy_dataset
from train.data.buckets import TrainingBatch, make_batch
from train.data.scenes import training_scene
from train.folder import RunFolder
from train.loop import muon, optim, step
from train.loop.checkpoints import path_of_step, read_checkpoint, saved_steps
from train.loop.crew import Crew
from train.loop.decision import Decision, move_along, move_towards
from train.loop.optim import Updater
from train.loop.state import TrainState, mean_share, new_state
from train.loop.step import Stepper
from train.loss.objective import Objective
from train.watching.rows import read_rows

CPU = torch.device("cpu")
SETTINGS = tiny_run(ema_decay=0.9, muon_rate=3.0, muon_takes="hidden", weight_decay=0.1)


@pytest.fixture
def late(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a processor decide as a card does."""
    for module in (step, optim, muon):
        monkeypatch.setattr(module, "decides_late", lambda _: True)


def batch(index: int, *, bad: bool = False) -> TrainingBatch:
    made = make_batch([training_scene(toy_sample(index), 16)])
    if bad:
        made.target_BVRR3[0, 0, 0, 0, 0] = math.inf
    return made


def taken(batches: list[TrainingBatch]) -> tuple[TrainState, list[bool]]:
    """Take steps and learn only at the end what they did."""
    state = new_state(SETTINGS, muon_precision="float32")
    stepper = Stepper(state, SETTINGS, Objective(SETTINGS.loss, None), Crew(device=CPU))
    unread = []
    for each in batches:
        unread.append(stepper.take([each], 3e-3))
        state.step += 1
    return state, [report.applied for report in stepper.read(unread).reports]


def tensors(state: TrainState) -> dict[str, Tensor]:
    assert state.mean_model is not None
    return {
        **state.model.state_dict(),
        **{f"mean/{name}": each for name, each in state.mean_model.state_dict().items()},
        **state.updater.memories(),
    }


def test_steps_that_are_not_finite_leave_no_trace(late: None) -> None:
    """Not in weights, means, memories or counts, at the start of a training or within it."""
    with_bad, applied = taken([batch(0, bad=True), batch(1), batch(0, bad=True), batch(2)])
    without, _ = taken([batch(1), batch(2)])
    assert applied == [False, True, False, True]
    found, wanted = tensors(with_bad), tensors(without)
    assert found.keys() == wanted.keys()
    for name, each in wanted.items():
        assert torch.equal(found[name], each), name


def test_kernels_update_as_the_host_does_but_for_rounding(
    request: pytest.FixtureRequest,
) -> None:
    host, late = with_gradients(), with_gradients()
    Updater(host, SETTINGS, "float32").step(3e-3)
    request.getfixturevalue("late")
    decision = Decision(applied=torch.tensor(True), updates=0, is_late=True)
    Updater(late, SETTINGS, "float32").step(3e-3, decision)
    for found, wanted in zip(late.parameters(), host.parameters(), strict=True):
        # units of the last place: the fused kernels add up in another order
        torch.testing.assert_close(found, wanted, rtol=2e-6, atol=1e-8)


@for_each("applied", [True, False])
def test_kernels_move_as_the_host_does_or_touch_nothing(applied: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    x, goal = (torch.randn(5, 7, generator=generator) for _ in range(2))
    if not applied:
        goal[0, 0] = math.nan
    decision = Decision(applied=torch.tensor(applied), updates=torch.tensor(30.0), is_late=True)
    share = mean_share(0.99, torch.tensor(30.0, dtype=torch.float64))
    assert float(share) == pytest.approx(mean_share(0.99, 30), rel=1e-7)
    assert isinstance(share, torch.Tensor) and share.dtype == torch.float32
    for move, by_hand in (
        (lambda y, late: move_towards([y], [goal], 0.05, late), x + 0.05 * (goal - x)),
        (lambda y, late: move_towards([y], [goal], share, late), x + float(share) * (goal - x)),
        (lambda y, late: move_along([y], [goal], 0.1, 0.02, late), 0.98 * x - 0.1 * goal),
    ):
        y = x.clone()
        move(y, decision)
        torch.testing.assert_close(y, by_hand if applied else x, rtol=1e-6, atol=1e-7)


def test_a_run_that_learns_late_is_the_same_run(
    late: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the window; skipped steps are named with their scenes; resumed to the bit."""
    write_toy_dataset(tmp_path / "data", train=6, validation=1)
    original = Stepper.take

    def spoilt(self: Stepper, batches: list[TrainingBatch], *given: Any, **rest: Any) -> Tensor:
        for each in batches if self._state.step in (1, 6) else ():
            each.target_BVRR3[:] = math.inf
        return original(self, batches, *given, **rest)

    monkeypatch.setattr(Stepper, "take", spoilt)

    def run(log_every: int, *, resume: bool = False) -> RunFolder:
        settings = tiny_run(num_steps=8, schedule="wsd", decay_share=0.4, log_every=log_every)
        out = tmp_path / f"window {log_every}"
        return trained(settings, [str(tmp_path / "data")], out, resume=resume).folder

    each, window = run(1), run(4)
    rows = [row for row in read_rows(window.metrics) if "loss" in row]
    first = [row["loss"] for row in read_rows(each.metrics) if "loss" in row][:4]
    assert first[1] is None
    assert rows[0]["loss"] == pytest.approx(sum(loss or 0 for loss in first) / 3)
    assert [row["skipped_steps"] for row in rows] == [1, 2]
    skips = [note for note in read_rows(window.notes) if "was skipped" in note["text"]]
    assert [note["step"] for note in skips] == [2, 7]
    assert all("its scenes were 0000" in note["text"] for note in skips)

    last = path_of_step(window.checkpoints, 8)
    wanted = read_checkpoint(path_of_step(each.checkpoints, 8)).arrays
    found = [read_checkpoint(last).arrays]
    last.unlink()
    assert saved_steps(window.checkpoints)[-1] == 5, "where the rate begins to fall: in a window"
    run(4, resume=True)
    found.append(read_checkpoint(last).arrays)
    for arrays in found:
        assert arrays.keys() == wanted.keys()
        assert all(np.array_equal(arrays[name], wanted[name]) for name in wanted)
