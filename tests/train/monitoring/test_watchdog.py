"""A step that does not end is told once, with the part it is in and the stacks, and goes on.

Two real processes, of which one is slow and once very slow, which this file is when it is run. And
what else a run tells of itself: times, layers, profiles, spikes, and the boards that show them.
"""

import copy
import gzip
import json
import math
import os
import re
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.summary.writer import event_file_writer
from torch import nn

from storage.dataset.dataset import Dataset
from storage.errors import TrilightError
from storage.seeds import rng_for
from tests.command_line import run_program
from tests.for_each import for_each
from tests.train.kit import ALONE, CPU, Heard, Killed, stepper, tiny_run, toy_batch, trained
from train.data import loader
from train.data.scenes import TrainingScene
from train.folder import RunFolder, read_rows
from train.loop.distributed import DistributedContext, join_processes
from train.loop.recorder import require_wandb, scalars
from train.loop.step import StepReport
from train.loop.train_state import new_state
from train.monitoring import process_monitor
from train.monitoring.process_monitor import (
    LEAST_REMEMBERED,
    OWN_PHASES,
    PHASES,
    SKIPPED_STEPS,
    Activity,
    LayerNorms,
    SpikeDetector,
    Watchdog,
    layer_of,
    merge_spikes,
    own_seconds,
    profiled_steps,
    slowest_rank,
    spike_bound,
)
from train.progress import TrainProgress
from train.run_training import run_training
from train.settings import WatchSettings


def until(done: Callable[[], object]) -> None:
    """Wait for another thread; a minute is long enough on any machine."""
    end = time.monotonic() + 60
    while not done():
        assert time.monotonic() < end
        time.sleep(0.01)


def sleeping_loader(said: list[str], count: int) -> None:
    """Stands for a read that hangs."""
    until(lambda: len(said) >= count)


def test_a_loader_that_sleeps_is_named_with_its_stack(tmp_path: Path) -> None:
    said: list[str] = []
    settings = WatchSettings(hang_after_s=0.1, hang_factor=2)
    activity = Activity()
    rest: dict[str, Any] = {"note": said.append, "report_hang": pytest.fail}
    with Watchdog(settings, activity, ALONE, tmp_path / "watching", **rest) as dog:
        for step in range(1, 5):
            dog.begin("step", step)
        activity.begin("data")
        dog.begin("step", 5)
        sleeping_loader(said, 2)
        dog.begin("step", 6)
        until(lambda: "step 5 went on after all" in said)
    first, again = said[0], said[1]
    assert first.startswith("process 0 of 1: step 5 has taken ")
    assert "s is usual; for " in first and "it has been in: waiting for data" in first
    assert again != first, "told again later, with the time of then"
    (path,) = (tmp_path / "watching").iterdir()
    assert path.name == "hang-step-000000005-rank-0.txt" and str(path) in first
    text = path.read_text()
    assert "sleeping_loader" in text and "process_monitor" in text, "stacks of all threads"
    assert text.count("process 0 of 1") == 2


def test_words_of_other_processes_are_passed_on_and_the_run_stops_if_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process_monitor, "GRACE_S", 0.3)
    said: list[str] = []
    ended: list[str] = []
    settings = WatchSettings(hang_after_s=0.1, on_hang="stop")
    others = tmp_path / "hang-step-000000007-rank-1.txt"
    old = tmp_path / "hang-step-000000007-rank-2.txt"
    for path in (others, old):
        path.write_text("process 1 of 2: in the loader\n\nThread 1\n")
    os.utime(others, (time.time() + 60, time.time() + 60))  # written while it hangs
    os.utime(old, (0, 0))  # of an earlier call
    pair = DistributedContext(device=CPU, world_size=2)
    rest: dict[str, Any] = {"note": said.append, "report_hang": ended.append}
    with Watchdog(settings, Activity(), pair, tmp_path, **rest) as dog:
        dog.begin("validation", 7)
        until(lambda: ended)
    assert "the validation after step 7 hangs" in ended[0] and len(ended) == 1
    passed_on = [text for text in said if text.startswith("process 1 of 2: in the loader")]
    assert len(passed_on) == 1 and str(others) in passed_on[0]


def test_a_full_disk_ends_no_watching(tmp_path: Path) -> None:
    said: list[str] = []
    (tmp_path / "watching").write_text("a file where the folder would be")
    settings, rest = WatchSettings(hang_after_s=0.1), {"note": said.append}
    place = tmp_path / "watching"
    with Watchdog(settings, Activity(), ALONE, place, **rest, report_hang=pytest.fail) as dog:
        dog.begin("step", 1)
        until(lambda: said)
    assert "Stacks" not in said[0]


def test_a_row_tells_parts_memory_and_layers_and_spikes_name_their_scenes(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Spikes by a bound so low that there are some."""
    monkeypatch.setattr(process_monitor, "LEAST_REMEMBERED", 2)
    monkeypatch.setattr(process_monitor, "LEAST_DEVIATION", 0.0)
    watched = WatchSettings(spike_bound=1.0)
    result = trained(tiny_run(), dataset, tmp_path, watched=watched)
    rows = read_rows(result.folder.metrics)
    windows = [row for row in rows if "loss" in row]
    assert [row["step"] for row in windows] == [2, 4, 6, 8, 10, 12]
    for row in windows:
        assert set(row["time_s"]) == set(PHASES)
        assert row["time_s"]["forward"] > 0 < row["time_s"]["backward"]
        assert row["memory_mb"].get("process", 100) > 50
        assert "decoder.head" in row["layers"] and "own_s" not in row
    # a window holds the validation and the saving that came before its first step
    assert windows[2]["time_s"]["validation"] > 0 < windows[2]["time_s"]["saving"]
    assert windows[1]["time_s"]["validation"] == 0
    found = [row for row in rows if "spike" in row]
    assert found
    for row in found:
        assert len(row["spike"]["keys"]) == 3 and row["spike"]["value"] > row["spike"]["bound"]
    assert read_rows(result.folder.notes)[0]["text"] == "began on cpu, 1 process"


@pytest.mark.slow("training")
def test_of_two_processes_the_slow_one_and_the_hanging_one_are_named(
    dataset: Dataset, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    words = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    words += ["-m", "tests.train.monitoring.test_watchdog", str(dataset.folder.root), str(out)]
    said = run_program(words, OMP_NUM_THREADS="1", GLOO_SOCKET_IFNAME="lo").stdout
    assert "process 1 of 2 is the slow one" in said
    first = r"process 0 of 2: step \d+ has taken .* exchange with the other processes"
    second = r"process 1 of 2: step \d+ has taken .* waiting for data\. Stacks"
    assert re.search(first, said), said
    assert re.search(second, said), said
    assert "went on after all" in said
    stacks = [path.read_text() for path in RunFolder(out).monitoring.glob("hang-*-rank-1.txt")]
    assert any("test_watchdog.py" in text and "sleeping" in text for text in stacks)
    rows = [row for row in read_rows(RunFolder(out).metrics) if "loss" in row]
    fast, slow = (sum(row["own_s"][rank] for row in rows) for rank in range(2))
    assert slow > fast, "seen by their own time, for that of a step is the same"
    assert any(row["time_s"]["exchange"] > 1 for row in rows), "the fast one waits in the exchange"
    texts = [note["text"] for note in read_rows(RunFolder(out).notes)]
    assert "began on cpu, 2 processes" in texts


SLEEP_S = 4.0


class Said(TrainProgress):
    """Prints notes."""

    def note(self, text: str) -> None:
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()


def slow_from(crew: DistributedContext) -> None:
    """Let the second process's loader sleep a little at each scene, and once for long."""
    made, count = loader._SceneMaker.scene, 0

    def sleeping(maker: loader._SceneMaker, place: loader.Visit) -> TrainingScene:
        nonlocal count
        count += 1
        time.sleep(SLEEP_S if count == 12 else 0.2)
        return made(maker, place)

    if not crew.is_first:
        setattr(loader._SceneMaker, "scene", sleeping)  # noqa: B010


def main(data: str, out: Path) -> None:
    settings = tiny_run(
        scenes_per_step=2, num_steps=16, log_every=4, validate_every=16, checkpoint_every=16
    )
    loader.PREFETCHED_SCENES = 1
    with join_processes("cpu") as crew:
        slow_from(crew)
        watched = WatchSettings(hang_after_s=1.0, hang_factor=2.0)
        run_training(
            settings, data=[data], out=out, dist_context=crew, watched=watched, progress=Said()
        )


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))


def test_the_parts_add_up_to_the_time_that_passed_and_end_with_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    activity = Activity()
    now_s += 1
    activity.begin("data")
    now_s += 2
    with activity.during("validation"):
        now_s += 4
        assert activity.now[0] == "validation"
    now_s += 8
    # sums of whole numbers below 2^53 are exact
    taken = {"other": 1, "data": 10, "validation": 4}
    assert activity.pop_seconds() == dict.fromkeys(PHASES, 0.0) | taken
    now_s += 16
    assert activity.pop_seconds()["data"] == 16, "what goes on counts up to now, and once"
    activity.begin("data")
    with pytest.raises(ValueError, match="x"), activity.during("saving"):
        raise ValueError("x")
    assert activity.now[0] == "data"


def test_a_process_stands_out_by_its_own_work_or_none_does() -> None:
    assert slowest_rank([0.1, 0.1, 0.5, 0.12]) == 2
    assert slowest_rank([0.5, 0.1]) == 0
    assert slowest_rank([1.0, 1.2, 1.1]) is None, "less than half more is no news"
    assert slowest_rank([0.001, 0.01]) is None, "milliseconds are no news"
    assert slowest_rank([1.0]) is None
    assert set(PHASES) - set(OWN_PHASES) == {"exchange", "validation", "saving"}
    assert own_seconds({**dict.fromkeys(PHASES, 0.0), "data": 3.0, "exchange": 9.0}, 2) == 1.5


@for_each("clip", [1e9, 1e-3])
def test_the_figures_are_those_of_an_update_before_clipping(clip: float) -> None:
    """A gradient that is not finite is none, and a missing one is nothing."""
    settings = tiny_run(grad_clip=clip)
    state = new_state(settings)
    watched = stepper(state)
    batch = toy_batch(0, 1)
    before = copy.deepcopy(dict(state.model.named_parameters()))
    watched.layers.is_due = True
    report = watched.step([batch], 3e-3)
    row = watched.layers.pop_row()
    squared: dict[str, np.ndarray] = {}
    for name, weight in state.model.named_parameters():
        old, new = (w.detach().double().numpy().ravel() for w in (before[name], weight))
        sums = squared.setdefault(layer_of(name), np.zeros(2))
        sums += [old @ old, (new - old) @ (new - old)]
    assert row.keys() == squared.keys()
    for layer, (_, weight_norm, ratio) in row.items():
        length = math.sqrt(squared[layer][0])
        # four digits are kept
        assert weight_norm == pytest.approx(length, rel=1e-3)
        assert ratio == pytest.approx(math.sqrt(squared[layer][1]) / length, rel=1e-3)
    whole = math.sqrt(sum((grad or 0) ** 2 for grad, _, _ in row.values()))
    assert whole == pytest.approx(report.grad_norm, rel=1e-3)
    watched.step([batch], 3e-3)
    assert watched.layers.pop_row() == {}, "nobody asked for this update"
    model = nn.Sequential(nn.Linear(2, 1, bias=False), nn.Linear(1, 1, bias=False))
    layers = LayerNorms(model)
    layers.is_due = True
    model[0].weight.grad = torch.full((1, 2), math.inf)
    with layers.measured_update():
        pass
    row = layers.pop_row()
    assert row["0.weight"][0] is None
    assert row["1.weight"][0] == 0 == row["1.weight"][2]


def test_the_trace_holds_the_steps_and_the_note_says_how_to_open_it(tmp_path: Path) -> None:
    """And what was not reached is told."""
    said: list[str] = []
    with profiled_steps(2, 10, CPU, tmp_path, said.append) as end_step:
        for _ in range(11, 18):
            torch.ones(3, 3) @ torch.ones(3, 3)
            end_step()
    trace, table = tmp_path / "profile-steps-14-to-15.json.gz", "profile-steps-14-to-15.txt"
    with gzip.open(trace) as stream:
        events = json.load(stream)["traceEvents"]
    assert sum(event.get("name") == "aten::mm" for event in events) == 2
    assert "aten::mm" in (tmp_path / table).read_text()
    (note,) = said
    assert str(trace) in note and "chrome://tracing" in note and table in note
    ended = "nothing was profiled: the run ended before step 4 of this call"
    for asked, steps, told in ((2, 1, [ended]), (0, 8, [])):
        said.clear()
        with profiled_steps(asked, 0, CPU, tmp_path / "none", said.append) as end_step:
            for _ in range(steps):
                end_step()
        assert said == told and not list(tmp_path.glob("none/*"))


@for_each("written", [True, False])
def test_a_step_that_fails_is_in_the_trace_and_a_trace_that_is_not_written_is_no_short_run(
    tmp_path: Path, written: bool
) -> None:
    folder = tmp_path / "traces"
    if not written:
        folder.write_text("no folder")
    told: list[str] = []
    error = RuntimeError if written else FileExistsError
    with pytest.raises(error), profiled_steps(2, 0, CPU, folder, told.append) as end_step:
        for _ in range(SKIPPED_STEPS):
            end_step()
        raise RuntimeError("step 4 fails")
    assert [text.partition(":")[0] for text in told] == ["steps 4 to 4 were profiled"] * written


REPORT = StepReport(loss=1.0, l1=1.0, brightness=1.0, grad_norm=0.1, applied=True)


def test_a_gradient_that_jumps_is_found_with_its_scenes_and_a_falling_loss_is_not() -> None:
    """A spike of one process alone ends no run."""
    watch, rng = SpikeDetector(8.0), rng_for(0, "spikes")
    found = []
    for step in range(1, 401):
        noise = np.exp(rng.normal(0, 0.1, 2))
        grad_norm = 5.0 if step == 300 else 0.1 * noise[0]
        loss = noise[1] / math.sqrt(step)
        report = replace(REPORT, loss=float(loss), grad_norm=float(grad_norm))
        found += watch.add(step, report, ["a", f"b{step}"])
    (spike,) = found
    bound = spike.pop("bound")
    assert spike == {"step": 300, "what": "grad_norm", "value": 5.0, "keys": ["a", "b300"]}
    # 8 deviations of 10 % above the median of 0.1; a median of 200 is sure to some per cent
    assert 0.15 < bound < 0.2
    # norms of two kinds of processors differ by rounding, and one may lie at the bound
    alike = {"step": 3, "what": "loss", "value": 2.0, "bound": 1.0}
    alone = {"step": 3, "what": "grad_norm", "value": 2.0, "bound": 1.9, "keys": ["b"]}
    found = merge_spikes([[{**alike, "keys": ["a"]}], [{**alike, "keys": ["b"]}, alone]])
    rest = {"what": "loss", "value": 2.0, "bound": 1.0}
    assert found == [{"step": 3, "spike": {**rest, "keys": ["a", "b"]}}]


def test_a_bound_is_median_and_deviations_and_neither_a_breath_nor_infinity_spikes() -> None:
    values = [1.0, 2.0, 3.0, 4.0, 100.0] * 20
    assert spike_bound(values, 2.0) == 3.0 + 2 * 1.4826 * 1.0
    assert spike_bound(values[: LEAST_REMEMBERED - 1], 2.0) is None
    watch = SpikeDetector(8.0)
    for step in range(100):
        assert watch.add(step, REPORT, []) == []
    assert watch.add(100, replace(REPORT, loss=1.1), []) == []
    assert watch.add(101, replace(REPORT, loss=math.nan, grad_norm=math.inf), []) == []
    assert watch.add(102, replace(REPORT, loss=1.5), ["k"]) == [
        {"step": 102, "what": "loss", "value": 1.5, "bound": 1.16, "keys": ["k"]}
    ]
    black = SpikeDetector(8.0)  # nothing is left to learn: its bound is 0 too
    for step in range(100):
        assert black.add(step, replace(REPORT, loss=0.0, grad_norm=0.0), []) == []


@for_each("mode", [None, "online"])
def test_wandb_follows_tensorboards_files_offline_or_as_the_user_says(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str | None
) -> None:
    package, out, files = MagicMock(), tmp_path / "mine", list[Path]()

    def init(**_: Any) -> Any:
        files.extend(out.glob("tensorboard/*"))
        return package.run

    package.init.side_effect = init
    monkeypatch.setitem(sys.modules, "wandb", package)
    monkeypatch.delenv("WANDB_MODE", raising=False)
    if mode:
        monkeypatch.setenv("WANDB_MODE", mode)
    trained(tiny_run(num_steps=4), dataset, out, watched=WatchSettings(wandb="light"))
    begun = dict(package.init.call_args.kwargs)
    config = begun.pop("config")
    assert (config["num_steps"], config["model"]["width"]) == (4, 36)
    assert begun == {
        "project": "light", "group": "mine", "dir": str(out), "mode": mode or "offline",
        "sync_tensorboard": True,
    }  # fmt: skip
    assert not files and list(out.glob("tensorboard/*")), "it sees only files that come after it"
    package.run.finish.assert_called_once_with()


def test_where_it_is_missing_a_run_that_asks_for_it_does_not_begin(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    require_wandb(None)
    with pytest.raises(TrilightError, match="wandb is not installed.*pip install wandb.*--wandb"):
        trained(tiny_run(), dataset, tmp_path, watched=WatchSettings(wandb="light"))
    assert list(tmp_path.iterdir()) == []


def test_groups_become_names_and_what_is_no_number_is_left_out() -> None:
    row = {
        "step": 4,
        "loss": 0.5,
        "l1": None,
        "time_s": {"data": 1.0},
        "memory_mb": {"process": 2.0},
        "layers": {"decoder.head": [1.0, 2.0, None]},
        "own_s": [0.1, 0.2],
    }
    assert scalars(row) == {
        "train/loss": 0.5,
        "time_s/data": 1.0,
        "memory_mb/process": 2.0,
        "grad_norm/decoder.head": 1.0,
        "weight_norm/decoder.head": 2.0,
        "own_s/process 0": 0.1,
        "own_s/process 1": 0.2,
    }
    assert scalars({"step": 4, "validation": {"log_l1": 0.1}}) == {"validation/log_l1": 0.1}
    assert scalars({"step": 4, "spike": {"value": 3.0, "keys": ["a"]}}) == {}


def test_curves_and_sheets_survive_a_resume(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # TensorBoard reads files of one second by the number of their writer: 10 before 9
    monkeypatch.setattr(event_file_writer, "_global_uid", event_file_writer.AtomicCounter(0))
    with pytest.raises(Killed):
        trained(tiny_run(), dataset, tmp_path, progress=Heard(killed_at=7))
    result = trained(tiny_run(), dataset, tmp_path, resume=True)
    events = EventAccumulator(str(result.folder.tensorboard)).Reload()
    rows = [row for row in read_rows(result.folder.metrics) if "loss" in row]
    shown = {event.step: event.value for event in events.Scalars("train/loss")}
    # TensorBoard keeps float32
    assert shown == pytest.approx({row["step"]: row["loss"] for row in rows}, rel=1e-6)
    assert [event.step for event in events.Scalars("validation/log_l1")] == [4, 8, 12]
    assert {event.step for event in events.Images("validation")} == {4, 8, 12}
    assert result.median_scores is not None
    median = [event.value for event in events.Scalars("validation/median_picture_log_l1")]
    assert median == pytest.approx([result.median_scores["log_l1"]] * 3, rel=1e-6)
