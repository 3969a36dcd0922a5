"""Around the steps: who trains where, what a signal does, and checkpoints written meanwhile.

Ctrl-C is answered at once and obeyed at the end of the step; a second one ends the run.
"""

import ctypes
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from model.checkpoint_format import saved_steps
from storage.dataset.dataset import Dataset
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.train.kit import tiny_run, trained
from train.folder import RunFolder
from train.loop import checkpoints, interrupts
from train.loop.background import BackgroundWriter
from train.loop.checkpoints import read_checkpoint
from train.loop.distributed import DistributedContext, choose_device, join_processes
from train.loop.interrupts import deferred_interrupts
from train.progress import TrainProgress


def test_without_torchrun_a_process_is_alone_and_no_missing_device_is_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    with join_processes("cpu") as crew:
        assert (crew.rank, crew.world_size, crew.is_first) == (0, 1, True)
        assert crew.mean([1.0, 2.0]) == [1.0, 2.0]
        assert crew.any(True) and not crew.any(False)
        assert crew.gather_text("å") == ["å"]
        assert (crew.rank_slice.rank, crew.rank_slice.world_size) == (0, 1)
    assert choose_device("cpu").type == "cpu"
    with pytest.raises(TrilightError, match="device 'tpu'; expected cpu or cuda"):
        choose_device("tpu")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    with pytest.raises(TrilightError, match="process 2 of this machine finds 2 GPUs"):
        choose_device("cuda", 2)


@for_each(("local_rank", "order"), [(0, "made waited"), (1, "waited made")])
def test_the_first_process_of_each_machine_makes_a_thing_before_the_others(
    monkeypatch: pytest.MonkeyPatch, local_rank: int, order: str
) -> None:
    done: list[str] = []

    def made() -> int:
        done.append("made")
        return 7

    monkeypatch.setattr(DistributedContext, "any", lambda *_: done.append("waited"))
    crew = DistributedContext(
        device=torch.device("cpu"), rank=8, world_size=16, local_rank=local_rank
    )
    assert crew.run_once_per_machine(made) == 7
    assert done == order.split()


NEVER_S = 60
TIMED_OUT = 110
"""errno's ETIMEDOUT."""


class TimeSpec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


@pytest.fixture(autouse=True)
def handled() -> Iterator[None]:
    """Tests that run in the background of a shell begin with a SIGINT that is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_it_is_answered_while_the_main_thread_is_in_a_call_that_does_not_return() -> None:
    """As a backward pass: Python's own handlers wait until it does. Here it waits for the answer.

    A mutex of the C library, because nothing of Python's blocks without hearing signals.
    """
    c, mutex = ctypes.CDLL(None), (ctypes.c_byte * 64)()
    answers: list[tuple[int, bool]] = []

    def answer(times: int) -> None:
        answers.append((times, threading.current_thread() is threading.main_thread()))
        c.pthread_mutex_unlock(mutex)

    assert c.pthread_mutex_lock(mutex) == 0
    deadline = TimeSpec(int(time.time()) + NEVER_S, 0)
    main = threading.main_thread().ident
    assert main is not None
    with deferred_interrupts(answer) as asked_to_stop:
        assert not asked_to_stop()
        press = threading.Timer(0.1, signal.pthread_kill, (main, signal.SIGINT))
        press.start()
        ended = c.pthread_mutex_timedlock(mutex, ctypes.byref(deadline))
        press.join()
        assert asked_to_stop()
    assert (ended, answers) == (0, [(1, False)]), ended == TIMED_OUT
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_second_signal_acts_as_it_did_before_but_not_what_torchrun_passes_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(interrupts, "ECHO_S", 0.0)
    with pytest.raises(KeyboardInterrupt), deferred_interrupts(lambda times: None) as asked:
        signal.raise_signal(signal.SIGINT)
        assert asked()
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler

    # the terminal sends Ctrl-C to all processes, and torchrun sends it to its own once more
    monkeypatch.setattr(interrupts, "ECHO_S", 3600.0)
    answers: list[int] = []
    with deferred_interrupts(answers.append) as asked:
        for number in (signal.SIGINT, signal.SIGINT, signal.SIGTERM):
            signal.raise_signal(number)
        assert asked()
    assert answers == [1]


PATIENCE_S = 60.0
"""Of a thread that waits for the other; on a busy machine a step takes tenths of a second."""


def full() -> None:
    raise TrilightError("the disk is full")


def test_work_is_done_in_order_and_its_errors_come_at_the_next_call() -> None:
    goes_on, done = threading.Event(), list[str]()

    def first() -> None:
        assert goes_on.wait(PATIENCE_S)
        done.append("first")

    with BackgroundWriter() as background:
        background.begin(first)
        assert done == []
        goes_on.set()
        background.begin(lambda: done.append("second"))
        assert done[0] == "first"
    assert done == ["first", "second"]
    background = BackgroundWriter()
    background.begin(full)
    with pytest.raises(TrilightError, match="the disk is full"):
        background.begin(lambda: None)
    background.wait()
    with pytest.raises(TrilightError, match="the disk is full"), BackgroundWriter() as other:
        other.begin(full)
    with pytest.raises(TrilightError, match="a loss") as error, BackgroundWriter() as background:
        background.begin(full)
        raise TrilightError("a loss is not finite")
    assert error.value.__notes__ == ["the disk is full"]


class Steps(TrainProgress):
    """Counts steps, and lets others wait for the next one."""

    def __init__(self) -> None:
        self.step = 0
        self._more = threading.Condition()

    def advance(self, *, step: int, **_: Any) -> None:
        with self._more:
            self.step = step
            self._more.notify_all()

    def beyond(self, step: int) -> bool:
        with self._more:
            return self._more.wait_for(lambda: self.step > step, PATIENCE_S)


def test_steps_go_on_while_a_disk_is_slow(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file of step 4 is not written before step 5 is done, and holds what step 4 left."""
    settings = tiny_run(num_steps=6)
    trained(settings, dataset, tmp_path / "quick")
    steps, write = Steps(), checkpoints._write_sealed

    def slowly(path: Path, encoded: bytes) -> None:
        assert steps.step == settings.num_steps or steps.beyond(steps.step)
        write(path, encoded)

    monkeypatch.setattr(checkpoints, "_write_sealed", slowly)
    trained(settings, dataset, tmp_path / "slow", progress=steps)
    slow, quick = (RunFolder(tmp_path / name).checkpoints for name in ("slow", "quick"))
    assert saved_steps(slow) == saved_steps(quick)
    for step in saved_steps(slow):
        ours, theirs = (
            read_checkpoint(checkpoints.path_of_step(folder, step)) for folder in (slow, quick)
        )
        assert ours.header["step"] == step
        assert all((ours.arrays[name] == theirs.arrays[name]).all() for name in theirs.arrays)
