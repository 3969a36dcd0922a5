"""Which checkpoints stay, and that a kill while one is saved leaves the one before it whole."""

import dataclasses
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from model.weights import encode_weights
from storage.errors import TrilightError
from tests.conftest import ROOT
from tests.train.kit import tiny_run
from train.folder import RunFolder
from train.loop.checkpoint import read_checkpoint, resumed_state
from train.loop.checkpoints import (
    checkpoint_path,
    keep_checkpoint,
    resumed_checkpoint,
    saved_steps,
)
from train.loop.crew import Crew
from train.loop.state import new_state
from train.networks import open_network

CREW = Crew(device=torch.device("cpu"))

CHILD = """
import os, signal, sys
from pathlib import Path
from tests.train.kit import tiny_run
from train.loop.checkpoints import keep_checkpoint
from train.loop.state import new_state

settings, state, folder = tiny_run(), new_state(tiny_run()), Path(sys.argv[1])

def keep(step):
    state.step = state.skipped_steps = step
    keep_checkpoint(folder, state, settings, data_digest="d", world_size=1)

keep(1)
name = sys.argv[2]
original = getattr(os, name)

def die(*arguments, **options):
    if sys.argv[3] == "after":
        original(*arguments, **options)
    os.kill(os.getpid(), signal.SIGKILL)

setattr(os, name, die)
keep(2)
"""


def no_note(text: str) -> None:
    raise AssertionError(text)


def kept(folder: Path, *steps: int) -> list[Path]:
    """Keep a checkpoint of each step; return their paths."""
    settings = tiny_run(checkpoints_kept=len(steps))
    state = new_state(settings)
    for state.step in steps:
        keep_checkpoint(folder, state, settings, data_digest="d", world_size=1)
    return [checkpoint_path(folder, step) for step in steps]


@pytest.mark.parametrize("damage", ["empty", "cut", "one byte of the header", "one of a weight"])
def test_a_damaged_newest_one_is_named_and_the_one_before_it_used(
    tmp_path: Path, damage: str
) -> None:
    _, newest = kept(tmp_path, 4, 8)
    data = bytearray(newest.read_bytes())
    place = {"one byte of the header": 300, "one of a weight": len(data) - 100}.get(damage)
    if place is not None:
        data[place] ^= 1
    newest.write_bytes(data[: {"empty": 0, "cut": len(data) // 2}.get(damage, len(data))])
    notes: list[str] = []
    assert resumed_checkpoint(tmp_path, CREW, noted=notes.append).header["step"] == 4
    (note,) = notes
    assert str(newest) in note and "goes on from the one before, of step 4" in note


def test_where_all_are_damaged_each_is_named(tmp_path: Path) -> None:
    paths = kept(tmp_path, 4, 8)
    for path in paths:
        path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(TrilightError, match="none of its checkpoints can be resumed") as refused:
        resumed_checkpoint(tmp_path, CREW, noted=no_note)
    assert all(str(path) in str(refused.value) for path in paths)


def test_any_byte_that_changed_is_found(tmp_path: Path) -> None:
    """A flip in a weight is a legal number, which no reader of safetensors would refuse."""
    (path,) = kept(tmp_path, 1)
    data = path.read_bytes()
    for place in np.random.default_rng(0).integers(len(data), size=40).tolist():
        flipped = bytearray(data)
        flipped[place] ^= 4
        path.write_bytes(flipped)
        with pytest.raises(TrilightError, match="is not readable"):
            read_checkpoint(path)


def test_the_newest_and_the_milestones_stay(tmp_path: Path) -> None:
    settings = tiny_run(checkpoints_kept=2, keep_every=10)
    state = new_state(settings)
    for step in (4, 8, 10, 12, 16, 20, 24):
        state.step = step
        keep_checkpoint(tmp_path, state, settings, data_digest="d", world_size=1)
    assert saved_steps(tmp_path) == [10, 20, 24]
    assert resumed_checkpoint(tmp_path, CREW, noted=no_note).header["step"] == 24
    (tmp_path / "step-notes.safetensors").write_bytes(b"")
    assert saved_steps(tmp_path) == [10, 20, 24]


@pytest.mark.parametrize(
    ("call", "when"),
    [("fsync", "before"), ("replace", "before"), ("replace", "after"), ("unlink", "before")],
)
def test_killed_while_saving_leaves_a_whole_one(tmp_path: Path, call: str, when: str) -> None:
    killed = subprocess.run(
        [sys.executable, "-c", CHILD, str(tmp_path), call, when], cwd=ROOT, check=False
    )
    assert killed.returncode == -signal.SIGKILL
    newest = resumed_checkpoint(tmp_path, CREW, noted=no_note)
    step = resumed_state(newest, tiny_run(), "d").step
    assert step == (1 if (call, when) in (("fsync", "before"), ("replace", "before")) else 2)
    state = new_state(tiny_run())
    state.step = state.skipped_steps = 3
    keep_checkpoint(tmp_path, state, tiny_run(), data_digest="d", world_size=1)
    assert not list(tmp_path.glob("*.part")), "what the killed one left is cleared away"


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
        open_network(tmp_path)
    keep_checkpoint(folder.checkpoints, state, settings, data_digest="d", world_size=1)
    for place in (tmp_path, checkpoint_path(folder.checkpoints, state.step)):
        assert (open_network(place).decoder.token_W == 0.25).all(), "the mean is what is shown"
    folder.weights.write_bytes(encode_weights(state.model))
    for place in (tmp_path, folder.weights):
        assert torch.equal(open_network(place).decoder.token_W, state.model.decoder.token_W)
