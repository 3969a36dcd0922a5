"""Checkpoints hold all that changes, a kill leaves the one before whole, and damage is refused.

Around the steps: who trains where, what a signal does, and checkpoints written meanwhile.
"""

import dataclasses
import errno
import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch
from safetensors.torch import save as save_tensors

from model.inference import NeuralRenderer
from model.open import HEADER_KEY, find_network, open_network, path_of_step, saved_steps
from model.weights import encode_weights
from storage.dataset.dataset import Dataset
from storage.digests import seal_of
from storage.errors import TrilightError
from storage.records.safe_read import read_safetensors
from storage.settings.described import from_record, settings_record
from tests.command_line import run_program
from tests.extensions_kit import EXAMPLES, loaded, written
from tests.for_each import case, for_each
from tests.train.kit import ALONE, TINY_MODEL, flip_a_bit, take_step, tiny_run, toy_batch, trained
from train.folder import RunFolder
from train.loop import checkpoints, interrupts
from train.loop.checkpoints import (
    UNSEALED,
    BackgroundWriter,
    newest_checkpoint,
    read_checkpoint,
    restore_state,
    save_checkpoint,
)
from train.loop.distributed import DistributedContext, choose_device, join_processes
from train.loop.interrupts import deferred_interrupts
from train.loop.train_state import TrainState, new_state
from train.progress import TrainProgress
from train.resume import plan_resume
from train.settings import TrainSettings, known_settings

KILLED_AT = {"fsync before": 1, "replace before": 1, "replace after": 2, "unlink before": 2}
"""The newest whole step of two, by the call at which a process is killed that saves the second."""

CHILD = """
import json, os, signal, sys
from pathlib import Path
from typing import Any
from storage.settings.described import from_record
from train.loop.checkpoints import save_checkpoint
from train.loop.train_state import new_state
from train.settings import TrainSettings
from train.settings import known_settings

settings = from_record(TrainSettings, json.loads(sys.argv[2]))
state = new_state(settings)

def keep(folder, step):
    state.step = state.skipped_steps = step
    save_checkpoint(folder, state, world_size=1)

def killed(folder, name, when):
    keep(folder, 1)
    original = getattr(os, name)

    def die(*arguments, **options):
        if when == "after":
            original(*arguments, **options)
        os.kill(os.getpid(), signal.SIGKILL)

    setattr(os, name, die)
    keep(folder, 2)

for case in sys.argv[3:]:
    child = os.fork()
    if child == 0:
        killed(Path(sys.argv[1]) / case, *case.split())
        os._exit(0)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL
"""


def test_the_newest_and_the_milestones_stay(tmp_path: Path) -> None:
    keep(tmp_path, 4, 8, 10, 12, 16, 20, 24, checkpoints_kept=2, keep_every=10)
    assert saved_steps(tmp_path) == [10, 20, 24]
    assert newest_checkpoint(tmp_path, ALONE, pytest.fail).header["step"] == 24
    (tmp_path / "step-notes.safetensors").write_bytes(b"")
    assert saved_steps(tmp_path) == [10, 20, 24]
    # where the decay begins a longer run can go on as if it had been longer all along
    keep(tmp_path / "wsd", 16, 20, 24, schedule="wsd", num_steps=25, checkpoints_kept=1)
    assert saved_steps(tmp_path / "wsd") == [20, 24]


def test_killed_while_saving_leaves_a_whole_one(tmp_path: Path) -> None:
    """A process leaves a folder for each call before or after which it is killed."""
    settings = json.dumps(settings_record(tiny_run()))
    run_program([sys.executable, "-c", CHILD, str(tmp_path), settings, *KILLED_AT])
    for name, left in KILLED_AT.items():
        with case(name):
            newest = newest_checkpoint(tmp_path / name, ALONE, pytest.fail)
            going = plan_resume(newest.header, tiny_run(), "", {})
            assert restore_state(newest, going).step == left
            keep(tmp_path / name, 3)
            left_over = list((tmp_path / name).glob("*.part"))
            assert not left_over, "what the killed one left is cleared away"


def keep(folder: Path, *steps: int, **changes: Any) -> None:
    """Save a run at steps that were all skipped."""
    settings = tiny_run(**({"checkpoints_kept": 3} | changes))
    state = new_state(settings)
    for step in steps:
        state.step = state.skipped_steps = step
        save_checkpoint(folder, state, world_size=1)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1000])


def lock(path: Path) -> None:
    path.unlink()
    path.mkdir()


@for_each("damage", [cut, flip_a_bit, lock])
def test_a_damaged_newest_one_is_named_and_the_one_before_it_is_used(
    damage: Callable[[Path], None], tmp_path: Path
) -> None:
    keep(tmp_path, 4, 8, 12)
    damage(path_of_step(tmp_path, 12))
    notes: list[str] = []
    assert newest_checkpoint(tmp_path, ALONE, notes.append).header["step"] == 8
    (note,) = notes
    assert f"checkpoint {path_of_step(tmp_path, 12)} is not readable: " in note
    assert note.endswith("The run goes on from that of step 8")
    for step in (8, 4):
        damage(path_of_step(tmp_path, step))
    with pytest.raises(
        TrilightError, match="none of its checkpoints can be resumed from"
    ) as caught:
        newest_checkpoint(tmp_path, ALONE, pytest.fail)
    for step in (4, 8, 12):
        assert f"{path_of_step(tmp_path, step)} is not readable" in str(caught.value)


def reseal(path: Path, **changes: object) -> None:
    """Change the header of a checkpoint, or its weights to NaN, and seal it as its writer does."""
    arrays, metadata = read_safetensors(path.read_bytes())
    weights = {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}
    if changes.pop("nan", False):
        next(iter(weights.values())).fill_(torch.nan)
    header = json.loads(metadata[HEADER_KEY]) | changes
    data = save_tensors(weights, metadata={HEADER_KEY: json.dumps(header | {"sha256": UNSEALED})})
    path.write_bytes(data.replace(UNSEALED.encode(), seal_of(data, UNSEALED).encode()))


@for_each(
    "lie",
    [{"step": "8"}, {"step": -1}, {"step": 10**13}, {"unusable": [1]}, {"unusable": {"a": -1}},
     {"settings": None}, {"model": None}, {"reports": [{"a": 1}]}, {"history": [{"a": 1}]},
     {"world_size": -1}, {"extensions": {"evil.py": 1}}, {"skipped_steps": 9},
     {"skipped_steps": -5}, {"evil": 1}, {"mixture": {}}, {"nan": True}],
)  # fmt: skip
def test_a_sealed_lie_is_passed_over(tmp_path: Path, lie: dict[str, object]) -> None:
    keep(tmp_path, 4, 8)
    reseal(path_of_step(tmp_path, 8))
    assert newest_checkpoint(tmp_path, ALONE, pytest.fail).header["step"] == 8
    reseal(path_of_step(tmp_path, 8), **lie)
    notes: list[str] = []
    assert newest_checkpoint(tmp_path, ALONE, notes.append).header["step"] == 4
    assert len(notes) == 1 and f"{path_of_step(tmp_path, 8)} is not readable: " in notes[0]


def test_a_damaged_later_one_takes_nobodys_place(tmp_path: Path) -> None:
    keep(tmp_path, 4, 12)
    flip_a_bit(path_of_step(tmp_path, 12))
    keep(tmp_path, 8, checkpoints_kept=1)
    assert newest_checkpoint(tmp_path, ALONE, lambda _: None).header["step"] == 8


@dataclasses.dataclass(frozen=True, kw_only=True)
class Two(DistributedContext):
    """Two processes, of which the other reads another step."""

    other: int
    world_size: int = 2

    def gather_text(self, text: str) -> list[str]:
        return [text, str(self.other)]


def test_processes_that_read_different_checkpoints_do_not_go_on(tmp_path: Path) -> None:
    keep(tmp_path, 4, 8)
    same = Two(device=ALONE.device, other=8)
    assert newest_checkpoint(tmp_path, same, pytest.fail).header["step"] == 8
    with pytest.raises(TrilightError, match="do not read the same checkpoint; this one .* step 8"):
        newest_checkpoint(tmp_path, Two(device=ALONE.device, other=4), pytest.fail)


def test_a_full_disk_leaves_the_older_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keep(tmp_path, 0, checkpoints_kept=1)
    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(os, "fsync", mock.Mock(side_effect=full))
    with pytest.raises(TrilightError, match="the disk is full"):
        keep(tmp_path, 5, checkpoints_kept=1)
    assert saved_steps(tmp_path) == [0]


def test_a_network_is_found_in_folder_checkpoint_and_file(tmp_path: Path) -> None:
    settings = dataclasses.replace(tiny_run(), ema_decay=0.9)
    state, folder = new_state(settings), RunFolder(tmp_path)
    assert state.ema_model is not None
    with torch.no_grad():
        state.ema_model.decoder.token_W.fill_(0.25)
    with pytest.raises(TrilightError, match="no checkpoint here"):
        open_network(tmp_path)
    save_checkpoint(folder.checkpoints, state, world_size=1)
    for place in (tmp_path, path_of_step(folder.checkpoints, 0)):
        found = find_network(place)
        assert found.trained.resolution == settings.resolution
        assert (found.open().decoder.token_W == 0.25).all(), "the mean is what is shown"
        renderer = NeuralRenderer.load(place, device="cpu")
        assert renderer.trained == found.trained
    folder.weights.write_bytes(encode_weights(state.model))
    for place in (tmp_path, folder.weights):
        assert torch.equal(open_network(place).decoder.token_W, state.model.decoder.token_W)


DIGEST = "d" * 64


def stepped(steps: int = 3) -> TrainState:
    state = new_state(tiny_run())
    for _ in range(steps):
        take_step(state, [toy_batch(0)], 1e-3)
    return state


def save(folder: Path, state: TrainState) -> Path:
    state.data_digest = DIGEST
    save_checkpoint(folder, state, world_size=1)
    return path_of_step(folder, state.step)


def load(path: Path) -> TrainState:
    checkpoint = read_checkpoint(path)
    typed = from_record(TrainSettings, known_settings(checkpoint.header["settings"], "resume"))
    return restore_state(checkpoint, plan_resume(checkpoint.header, typed, DIGEST, {}))


def test_equal_states_give_equal_bytes_and_skipped_steps_are_no_updates(tmp_path: Path) -> None:
    one, other = (save(tmp_path / name, stepped()) for name in "ab")
    assert one.read_bytes() == other.read_bytes()
    state = stepped(2)
    state.step, state.skipped_steps = 5, 3
    loaded = load(save(tmp_path / "c", state))
    for each in (loaded, state):
        take_step(each, [toy_batch(1)], 1e-3)
    # AdamW's steps are the longer the fewer it believes to have done
    ours, theirs = loaded.model.state_dict(), state.model.state_dict()
    assert all(torch.equal(ours[key], theirs[key]) for key in ours)


def test_nothing_may_be_missing_and_no_bit_may_flip(tmp_path: Path) -> None:
    """In the header, its sha256, the weights, the last byte: each would still be a weight."""
    with pytest.raises(TrilightError, match="no checkpoint here to resume from"):
        newest_checkpoint(tmp_path / "checkpoints", ALONE, print)
    path = save(tmp_path, stepped(1))
    data = path.read_bytes()
    end = 8 + int.from_bytes(data[:8], "little")
    places = [0, 8, *range(9, end, end // 40), data.index(b"sha256") + 20]
    wrong = [b"", data[:100], data[:-1], b"PK\x03\x04" + data]
    for place in [*places, end, end + 4321, len(data) - 1]:
        flipped = bytearray(data)
        flipped[place] ^= 1 << place % 8
        wrong.append(bytes(flipped))
    for damaged in wrong:
        path.write_bytes(damaged)
        with pytest.raises(TrilightError, match=f"checkpoint {path} is not readable"):
            read_checkpoint(path)
    path.write_bytes(data)
    assert load(path).step == 1


def test_a_run_of_an_extension_is_resumed_with_the_same_one_only(tmp_path: Path) -> None:
    size = EXAMPLES / "model_size.py"
    with loaded(size) as extension:
        path = save(tmp_path, stepped(0))
        load(path)
    assert read_checkpoint(path).header["extensions"] == {"model_size.py": extension.sha256}
    assert read_checkpoint(path).network().config == TINY_MODEL  # the network asks for no file
    with pytest.raises(TrilightError, match=r"begun with the extension model_size\.py, which is"):
        load(path)
    changed = written(tmp_path, size.read_text() + "# changed\n", "model_size.py")
    with loaded(changed), pytest.raises(TrilightError, match=r"another extension model_size\.py"):
        load(path)
    with loaded(EXAMPLES / "metric.py"):  # judges, and decides no weight
        save(tmp_path, stepped(0))
    assert "extensions" not in read_checkpoint(path).header


def test_without_torchrun_a_process_is_alone_and_no_missing_device_is_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    with join_processes("cpu") as crew:
        assert (crew.rank, crew.world_size, crew.is_first) == (0, 1, True)
        assert crew.mean_on_device(torch.ones(2)).tolist() == [1.0, 1.0]
        assert crew.any(True) and not crew.any(False)
        assert crew.gather_text("å") == ["å"]
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


@pytest.fixture(autouse=True)
def handled() -> Iterator[None]:
    """Tests that run in the background of a shell begin with a SIGINT that is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


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
