"""Checkpoints hold all that changes, and are refused where they do not belong."""

from pathlib import Path

import pytest
import torch

from storage.errors import TrilightError
from storage.settings.described import from_record
from tests.extensions_kit import EXAMPLES, loaded, written
from tests.for_each import for_each
from tests.train.kit import TINY_MODEL, tiny_run
from tests.train.toy import toy_sample
from train.data.buckets import TrainingBatch, make_batch
from train.data.scenes import training_scene
from train.going_on import going_on
from train.loop.checkpoints import (
    read_checkpoint,
    resumed_checkpoint,
    resumed_state,
    save_checkpoint,
)
from train.loop.crew import Crew
from train.loop.recorder import MetricsLog
from train.loop.state import TrainState, new_state
from train.loop.step import Stepper
from train.loss.objective import Objective
from train.settings import TrainSettings
from train.watching.rows import read_rows

DIGEST = "d" * 64


def trained(steps: int = 3) -> TrainState:
    state = new_state(tiny_run())
    batch = make_batch([training_scene(toy_sample(0), 16)])
    for _ in range(steps):
        one_step(state, batch)
    return state


def one_step(state: TrainState, batch: TrainingBatch) -> None:
    settings = tiny_run()
    crew = Crew(device=torch.device("cpu"))
    Stepper(state, settings, Objective(settings.loss, None), crew).step([batch], 1e-3)
    state.step += 1


def equal_weights(one: TrainState, other: TrainState) -> bool:
    ours, theirs = one.model.state_dict(), other.model.state_dict()
    return all(torch.equal(ours[key], theirs[key]) for key in ours)


def save(path: Path, state: TrainState, settings: TrainSettings | None = None) -> None:
    save_checkpoint(path, state, settings or tiny_run(), data_digest=DIGEST, world_size=1)


def load(path: Path) -> TrainState:
    checkpoint = read_checkpoint(path)
    typed = from_record(TrainSettings, checkpoint.header["settings"])
    return resumed_state(checkpoint, going_on(checkpoint.header, typed, DIGEST, {}))


@for_each("steps", [0, 3])
def test_a_loaded_state_goes_on_to_the_bit(tmp_path: Path, steps: int) -> None:
    state = trained(steps)
    path = tmp_path / "checkpoint"
    save(path, state)
    loaded = load(path)
    assert (loaded.step, loaded.skipped_steps) == (state.step, state.skipped_steps)
    batch = make_batch([training_scene(toy_sample(1), 16)])
    for each in (state, loaded):
        one_step(each, batch)
    assert equal_weights(state, loaded)


def test_equal_states_give_equal_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        save(tmp_path / name, trained())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_damage_that_was_met_is_not_forgotten(tmp_path: Path) -> None:
    settings = tiny_run(most_unusable=3)
    state = new_state(settings)
    error = TrilightError("x")
    for name in ("b", "a"):
        state.unusable.add(name, 1, error)
    save(tmp_path / "c", state, settings)
    loaded = load(tmp_path / "c").unusable
    assert loaded.met == state.unusable.met and loaded.messages == ()
    loaded.add("a", 1, error)
    loaded.add("c", 1, error)
    with pytest.raises(TrilightError, match="4 samples are unusable; expected at most 3"):
        loaded.add("d", 1, error)


def test_skipped_steps_do_not_count_as_updates(tmp_path: Path) -> None:
    state = trained(2)
    state.step, state.skipped_steps = 5, 3
    save(tmp_path / "c", state)
    loaded = load(tmp_path / "c")
    batch = make_batch([training_scene(toy_sample(1), 16)])
    one_step(loaded, batch)
    one_step(state, batch)
    # AdamW's steps are the longer the fewer it believes to have done
    assert equal_weights(loaded, state)


def test_a_missing_or_damaged_checkpoint_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TrilightError, match="no checkpoint here to resume from"):
        resumed_checkpoint(tmp_path / "checkpoints", Crew(device=torch.device("cpu")), print)
    save(tmp_path / "c", new_state(tiny_run()))
    data = (tmp_path / "c").read_bytes()
    for damaged in (b"", data[:100], data[:-1], b"PK\x03\x04" + data):
        (tmp_path / "c").write_bytes(damaged)
        with pytest.raises(TrilightError, match=f"checkpoint {tmp_path / 'c'} is not readable"):
            load(tmp_path / "c")


def test_no_bit_may_flip(tmp_path: Path) -> None:
    """In the header, its sha256, the weights, the last byte: each would still be a weight."""
    path = tmp_path / "c"
    save(path, trained(1))
    data = path.read_bytes()
    end = 8 + int.from_bytes(data[:8], "little")
    places = [0, 8, *range(9, end, end // 40), data.index(b"sha256") + 20]
    for place in [*places, end, end + 4321, len(data) - 1]:
        damaged = bytearray(data)
        damaged[place] ^= 1 << place % 8
        path.write_bytes(damaged)
        with pytest.raises(TrilightError, match="is not readable"):
            read_checkpoint(path)
    path.write_bytes(data)
    assert load(path).step == 1


def test_the_log_is_cut_back_to_the_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    log = MetricsLog(path, first_step=0)
    for step in (2, 4, 6):
        log.append({"step": step, "loss": 1.0 / step})
    with path.open("a") as stream:
        stream.write('{"step": 8, "lo')
    MetricsLog(path, first_step=4)
    assert [row["step"] for row in read_rows(path)] == [2, 4]


def test_a_run_of_an_extension_is_resumed_with_the_same_one_only(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint"
    size = EXAMPLES / "model_size.py"
    with loaded(size) as extension:
        save(path, trained(0))
        load(path)
    assert read_checkpoint(path).header["extensions"] == {"model_size.py": extension.sha256}
    assert read_checkpoint(path).network().config == TINY_MODEL  # the network asks for no file
    with pytest.raises(TrilightError, match=r"begun with the extension model_size\.py, which is"):
        load(path)
    changed = written(tmp_path, size.read_text() + "# changed\n", "model_size.py")
    with loaded(changed), pytest.raises(TrilightError, match=r"another extension model_size\.py"):
        load(path)
    with loaded(EXAMPLES / "metric.py"):  # judges, and decides no weight
        save(path, trained(0))
    assert "extensions" not in read_checkpoint(path).header
