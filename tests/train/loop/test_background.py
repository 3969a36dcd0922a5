"""Checkpoints are written while steps go on, and no error and no file is lost by that."""

import threading
from pathlib import Path

import pytest

from storage.errors import TrilightError
from tests.train.kit import tiny_run, trained
from tests.train.toy import write_toy_dataset
from train.folder import RunFolder
from train.loop import checkpoints
from train.loop.background import Background
from train.loop.checkpoints import read_checkpoint, saved_steps
from train.progress import TrainProgress

PATIENCE_S = 60.0
"""Of a thread that waits for the other; on a busy machine a step takes tenths of a second."""


def full() -> None:
    raise TrilightError("the disk is full")


def test_one_piece_of_work_after_another() -> None:
    goes_on, done = threading.Event(), list[str]()

    def first() -> None:
        assert goes_on.wait(PATIENCE_S)
        done.append("first")

    with Background() as background:
        background.begin(first)
        assert done == []
        goes_on.set()
        background.begin(lambda: done.append("second"))
        assert done[0] == "first"
    assert done == ["first", "second"]


def test_an_error_is_raised_at_the_next_call_or_at_the_end() -> None:
    background = Background()
    background.begin(full)
    with pytest.raises(TrilightError, match="the disk is full"):
        background.begin(lambda: None)
    background.wait()
    with pytest.raises(TrilightError, match="the disk is full"), Background() as other:
        other.begin(full)


def test_an_error_does_not_hide_another() -> None:
    with pytest.raises(TrilightError, match="a loss") as error, Background() as background:
        background.begin(full)
        raise TrilightError("a loss is not finite")
    assert error.value.__notes__ == ["the disk is full"]


class Steps(TrainProgress):
    """Counts steps, and lets others wait for the next one."""

    def __init__(self) -> None:
        self.step = 0
        self._more = threading.Condition()

    def advance(self, *, step: int, loss: float, learning_rate: float, views_per_s: float) -> None:
        with self._more:
            self.step = step
            self._more.notify_all()

    def beyond(self, step: int) -> bool:
        with self._more:
            return self._more.wait_for(lambda: self.step > step, PATIENCE_S)


def test_steps_go_on_while_a_disk_is_slow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file of step 4 is not written before step 5 is done, and holds what step 4 left."""
    data = write_toy_dataset(tmp_path / "toy", train=4, validation=2, per_shard=2)
    place = [str(data.folder.root)]
    settings = tiny_run(num_steps=6)
    trained(settings, place, tmp_path / "quick")
    steps, write = Steps(), checkpoints._write_sealed

    def slowly(path: Path, encoded: bytes) -> None:
        assert steps.step == settings.num_steps or steps.beyond(steps.step)
        write(path, encoded)

    monkeypatch.setattr(checkpoints, "_write_sealed", slowly)
    trained(settings, place, tmp_path / "slow", progress=steps)
    slow, quick = (RunFolder(tmp_path / name).checkpoints for name in ("slow", "quick"))
    assert saved_steps(slow) == saved_steps(quick)
    for step in saved_steps(slow):
        ours, theirs = (
            read_checkpoint(checkpoints.path_of_step(folder, step)) for folder in (slow, quick)
        )
        assert ours.header["step"] == step
        assert all((ours.arrays[name] == theirs.arrays[name]).all() for name in theirs.arrays)
