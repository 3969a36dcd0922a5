"""A trace is written for the steps that were asked for, and none without."""

import gzip
import json
from pathlib import Path

import torch

from train.watching.profiler import StepProfiler

CPU = torch.device("cpu")


def test_the_trace_holds_the_steps_and_the_note_says_how_to_open_it(tmp_path: Path) -> None:
    said: list[str] = []
    profiler = StepProfiler(2, CPU, tmp_path, said.append)
    for step in range(11, 18):
        profiler.begins(step)
        torch.ones(3, 3) @ torch.ones(3, 3)
        profiler.ends(step)
    profiler.close(17)
    trace, table = tmp_path / "profile-steps-14-to-15.json.gz", "profile-steps-14-to-15.txt"
    with gzip.open(trace) as stream:
        events = json.load(stream)["traceEvents"]
    assert sum(event.get("name") == "aten::mm" for event in events) == 2
    assert "aten::mm" in (tmp_path / table).read_text()
    (note,) = said
    assert str(trace) in note and "chrome://tracing" in note and table in note


def test_what_was_not_reached_is_told(tmp_path: Path) -> None:
    said: list[str] = []
    profiler = StepProfiler(2, CPU, tmp_path, said.append)
    profiler.begins(1)
    profiler.ends(1)
    profiler.close(1)
    assert said == ["nothing was profiled: the run ended before step 4 of this call"]
    off = StepProfiler(0, CPU, tmp_path, said.append)
    for step in range(1, 9):
        off.begins(step)
        off.ends(step)
    off.close(8)
    assert len(said) == 1 and list(tmp_path.iterdir()) == []
