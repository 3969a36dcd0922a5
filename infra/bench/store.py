"""Results on disk: one JSON line a point and turn, so that a run goes on where it was killed.

A file holds the runs of one experiment, one after the other. Of a run the first line is its plan,
the last one its end; a line that was being written when the power failed is cut off.
"""

import datetime
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from infra.bench.experiment import Figures


@dataclass(kw_only=True)
class Run:
    """One run, finished or not."""

    plan: Mapping[str, Any]
    """All that its figures depend on: points, turns, effort, what was asked for, machine."""
    date: str
    """The day on which it began, such as 2026-11-22."""
    turns: dict[str, dict[str, Figures]] = field(default_factory=dict)
    """Figures by turn and point."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Turns that count for no point: why."""
    columns: dict[str, dict[str, float]] = field(default_factory=dict)
    """Columns by point, of results that were converted from an older form."""
    notes: list[str] = field(default_factory=list)
    """Facts that belong to the result, such as the network's name."""
    seconds: float | None = None
    """Wall time since the run last resumed; None where it has not ended."""

    def whole_turns(self) -> list[str]:
        """Return the turns in which every point of the plan was measured."""
        points = set(self.plan["points"])
        return [turn for turn in self.plan["turns"] if points <= set(self.turns.get(turn, {}))]

    def missing_turns(self) -> list[str]:
        """Return the turns that are still to be measured."""
        done = {*self.whole_turns(), *self.left_out}
        return [turn for turn in self.plan["turns"] if turn not in done]


class Store:
    """The runs of one experiment at one effort."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def runs(self) -> list[Run]:
        """Return all runs, oldest first; none where there is no file."""
        found: list[Run] = []
        for line in self._whole_lines():
            record = json.loads(line)
            if "plan" in record:
                found.append(Run(plan=record["plan"], date=record["date"]))
            else:
                _take(found[-1], record)
        return found

    def newest(self) -> Run | None:
        """Return the last run that has ended."""
        return next((run for run in reversed(self.runs()) if run.seconds is not None), None)

    def begin(self, plan: Mapping[str, Any]) -> Run:
        """Return the last run where it has this plan and has not ended, else a new one."""
        plain = json.loads(json.dumps(plan))
        runs = self.runs()
        if runs and runs[-1].seconds is None and runs[-1].plan == plain:
            return runs[-1]
        today = datetime.date.today().isoformat()
        self._append({"plan": plain, "date": today})
        return Run(plan=plain, date=today)

    def add(self, run: Run, turn: str, point: str, figures: Figures) -> None:
        """Write the figures of one point in one turn."""
        record = {"turn": turn, "point": point, "figures": dict(figures)}
        self._append(record)
        _take(run, record)

    def leave_out(self, run: Run, turn: str, why: str) -> None:
        """Write that a turn counts for no point."""
        record = {"turn": turn, "left_out": why}
        self._append(record)
        _take(run, record)

    def end(self, run: Run, seconds: float, notes: list[str]) -> None:
        """Write that a run has ended."""
        record = {"seconds": seconds, "notes": notes}
        self._append(record)
        _take(run, record)

    def _whole_lines(self) -> list[bytes]:
        data = self.path.read_bytes() if self.path.is_file() else b""
        return data[: data.rfind(b"\n") + 1].splitlines()

    def _append(self, record: Mapping[str, Any]) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("ab+") as stream:
            stream.seek(0)
            stream.truncate(stream.read().rfind(b"\n") + 1)  # a torn line of a killed run
            stream.write(json.dumps(record, sort_keys=True, allow_nan=False).encode() + b"\n")
            stream.flush()
            os.fsync(stream.fileno())


def _take(run: Run, record: Mapping[str, Any]) -> None:
    if "figures" in record:
        run.turns.setdefault(record["turn"], {})[record["point"]] = record["figures"]
    elif "left_out" in record:
        run.left_out[record["turn"]] = record["left_out"]
    elif "columns" in record:
        run.columns[record["point"]] = record["columns"]
    else:
        run.seconds, run.notes = record["seconds"], record["notes"]
