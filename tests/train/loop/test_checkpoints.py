"""Which checkpoints stay, and that a kill while one is saved leaves the one before it whole."""

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
import torch

from model.neural_renderer import NeuralRenderer
from model.open import find_network, open_network
from model.weights import encode_weights
from storage.errors import TrilightError
from storage.settings.described import settings_record
from tests.conftest import ROOT
from tests.for_each import for_each
from tests.train.kit import tiny_run
from train.folder import RunFolder
from train.going_on import going_on
from train.loop.checkpoints import (
    keep_checkpoint,
    network_of_run,
    path_of_step,
    resumed_checkpoint,
    resumed_state,
    saved_steps,
)
from train.loop.crew import Crew
from train.loop.state import new_state

ALONE = Crew(device=torch.device("cpu"))

CASES = [("fsync", "before"), ("replace", "before"), ("replace", "after"), ("unlink", "before")]

CHILD = """
import json, os, signal, sys
from pathlib import Path
from storage.settings.described import from_record
from train.loop.checkpoints import keep_checkpoint
from train.loop.state import new_state
from train.settings import TrainSettings

settings = from_record(TrainSettings, json.loads(sys.argv[2]))
state = new_state(settings)

def keep(folder, step):
    state.step = state.skipped_steps = step
    keep_checkpoint(folder, state, settings, data_digest="d", world_size=1)

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


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with one of each case, which a killed process has left."""
    folder, cases = tmp_path_factory.mktemp("killed"), [" ".join(case) for case in CASES]
    settings = json.dumps(settings_record(tiny_run()))
    command = [sys.executable, "-c", CHILD, str(folder), settings, *cases]
    subprocess.run(command, cwd=ROOT, check=True)
    return folder


def test_the_newest_and_the_milestones_stay(tmp_path: Path) -> None:
    settings = tiny_run(checkpoints_kept=2, keep_every=10)
    state = new_state(settings)
    for step in (4, 8, 10, 12, 16, 20, 24):
        state.step = step
        keep_checkpoint(tmp_path, state, settings, data_digest="d", world_size=1)
    assert saved_steps(tmp_path) == [10, 20, 24]
    assert resumed_checkpoint(tmp_path, ALONE, pytest.fail).header["step"] == 24
    (tmp_path / "step-notes.safetensors").write_bytes(b"")
    assert saved_steps(tmp_path) == [10, 20, 24]


def test_the_one_where_the_decay_begins_stays(tmp_path: Path) -> None:
    """It is the last from which a longer run can go on as if it had been longer all along."""
    settings = tiny_run(schedule="wsd", num_steps=25, checkpoints_kept=1)
    state = new_state(settings)
    for step in (16, 20, 24):
        state.step = step
        keep_checkpoint(tmp_path, state, settings, data_digest="d", world_size=1)
    assert saved_steps(tmp_path) == [20, 24]


@for_each(("call", "when"), CASES)
def test_killed_while_saving_leaves_a_whole_one(killed: Path, call: str, when: str) -> None:
    folder = killed / f"{call} {when}"
    newest = resumed_checkpoint(folder, ALONE, pytest.fail)
    step = resumed_state(newest, going_on(newest.header, tiny_run(), "d", {})).step
    assert step == (1 if (call, when) in (("fsync", "before"), ("replace", "before")) else 2)
    state = new_state(tiny_run())
    state.step = state.skipped_steps = 3
    keep_checkpoint(folder, state, tiny_run(), data_digest="d", world_size=1)
    assert not list(folder.glob("*.part")), "what the killed one left is cleared away"


def keep(folder: Path, *steps: int, kept: int = 3) -> None:
    state = new_state(tiny_run())
    for step in steps:
        state.step = state.skipped_steps = step
        settings = tiny_run(checkpoints_kept=kept)
        keep_checkpoint(folder, state, settings, data_digest="d", world_size=1)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1000])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[-1000] ^= 1
    path.write_bytes(data)


def lock(path: Path) -> None:
    path.unlink()
    path.mkdir()


@for_each("damage", [cut, flip, lock])
def test_a_damaged_newest_one_is_named_and_the_one_before_it_is_used(
    damage: Callable[[Path], None], tmp_path: Path
) -> None:
    keep(tmp_path, 4, 8, 12)
    damage(path_of_step(tmp_path, 12))
    notes: list[str] = []
    assert resumed_checkpoint(tmp_path, ALONE, notes.append).header["step"] == 8
    (note,) = notes
    assert f"checkpoint {path_of_step(tmp_path, 12)} is not readable: " in note
    assert note.endswith("The run goes on from that of step 8")
    for step in (8, 4):
        damage(path_of_step(tmp_path, step))
    with pytest.raises(
        TrilightError, match="none of its checkpoints can be resumed from"
    ) as caught:
        resumed_checkpoint(tmp_path, ALONE, pytest.fail)
    for step in (4, 8, 12):
        assert f"{path_of_step(tmp_path, step)} is not readable" in str(caught.value)


def test_a_damaged_later_one_takes_nobodys_place(tmp_path: Path) -> None:
    keep(tmp_path, 4, 12)
    flip(path_of_step(tmp_path, 12))
    keep(tmp_path, 8, kept=1)
    assert resumed_checkpoint(tmp_path, ALONE, lambda _: None).header["step"] == 8


@dataclasses.dataclass(frozen=True, kw_only=True)
class Two(Crew):
    """Two processes, of which the other reads another step."""

    other: int
    world_size: int = 2

    def mean(self, values: Sequence[float]) -> list[float]:
        theirs = [self.other >> bit & 1 for bit in range(len(values))]
        return [(own + other) / 2 for own, other in zip(values, theirs, strict=True)]


def test_processes_that_read_different_checkpoints_do_not_go_on(tmp_path: Path) -> None:
    keep(tmp_path, 4, 8)
    same = Two(device=ALONE.device, other=8)
    assert resumed_checkpoint(tmp_path, same, pytest.fail).header["step"] == 8
    with pytest.raises(TrilightError, match="do not read the same checkpoint; this one .* step 8"):
        resumed_checkpoint(tmp_path, Two(device=ALONE.device, other=4), pytest.fail)


def test_a_full_disk_leaves_the_older_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings, state = tiny_run(checkpoints_kept=1), new_state(tiny_run())
    keep_checkpoint(tmp_path, state, settings, data_digest="d", world_size=1)

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    state.step = 5
    with pytest.raises(TrilightError, match="the disk is full"):
        keep_checkpoint(tmp_path, state, settings, data_digest="d", world_size=1)
    assert saved_steps(tmp_path) == [0]


def test_a_network_is_found_in_folder_checkpoint_and_file(tmp_path: Path) -> None:
    settings = dataclasses.replace(tiny_run(), ema_decay=0.9)
    state, folder = new_state(settings), RunFolder(tmp_path)
    assert state.mean_model is not None
    with torch.no_grad():
        state.mean_model.decoder.token_W.fill_(0.25)
    with pytest.raises(TrilightError, match="no checkpoint here"):
        open_network(tmp_path, network_of_run)
    keep_checkpoint(folder.checkpoints, state, settings, data_digest="d", world_size=1)
    for place in (tmp_path, path_of_step(folder.checkpoints, 0)):
        found = find_network(place, network_of_run)
        assert found.trained.resolution == settings.resolution
        assert (found.open().decoder.token_W == 0.25).all(), "the mean is what is shown"
        renderer = NeuralRenderer.load(place, device="cpu", finders=[network_of_run])
        assert renderer.trained == found.trained
    folder.weights.write_bytes(encode_weights(state.model))
    for place in (tmp_path, folder.weights):
        assert torch.equal(
            open_network(place, network_of_run).decoder.token_W, state.model.decoder.token_W
        )
