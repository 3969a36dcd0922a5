"""Results on disk: a JSON line for each point and trial, so that a killed run resumes.

A file holds the runs of one experiment, one after the other. The first line of a run is its plan
with machine, commit and date, its last line is the end; an incomplete line of a killed run is cut
off.
"""

import datetime
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from infra.bench.experiment import Figures
from storage.atomic import append_line
from storage.errors import TrilightError
from storage.typed_json import read_json_lines


@dataclass(kw_only=True)
class Run:
    """Run of an experiment, finished or not."""

    plan: Mapping[str, Any]
    """Everything that its figures depend on: points, trials, scale, options, machine."""
    date: str
    """Day of its start, such as 2026-11-22."""
    trials: dict[str, dict[str, Figures]] = field(default_factory=dict)
    """Figures by trial and point."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Reason by trial of trials that count for no point."""
    notes: list[str] = field(default_factory=list)
    """Remarks on the result, such as the network's name."""
    seconds: float | None = None
    """Wall-clock seconds since the run last resumed; None for an unfinished run."""

    def whole_trials(self) -> list[str]:
        """Return the trials that have every point of the plan."""
        points = {point["name"] for point in self.plan["points"]}
        return [trial for trial in self.plan["trials"] if points <= set(self.trials.get(trial, {}))]

    def missing_trials(self) -> list[str]:
        """Return the trials that are not measured yet."""
        done = {*self.whole_trials(), *self.left_out}
        return [trial for trial in self.plan["trials"] if trial not in done]


class Store:
    """File with the runs of one experiment."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def runs(self) -> list[Run]:
        """Return all runs, oldest first; empty without a file.

        Raises:
            TrilightError: the file holds no runs.
        """
        data = self.path.read_bytes() if self.path.is_file() else b""
        runs: list[Run] = []
        try:
            for record in read_json_lines(data, dict[str, Any], str(self.path), torn_end=True):
                if "plan" in record:
                    runs.append(Run(plan=record["plan"], date=record["date"]))
                else:
                    _take(runs[-1], record)
        except (ValueError, LookupError, TypeError) as error:
            raise TrilightError(
                f"{self.path}: no rows of `trilight bench` ({error}); expected a file that it "
                "wrote. Name another one by --out."
            ) from error
        return runs

    def newest(self) -> Run | None:
        """Return the last finished run, or None."""
        return next((run for run in reversed(self.runs()) if run.seconds is not None), None)

    def begin(self, plan: Mapping[str, Any]) -> Run:
        """Return the last run if it is unfinished and has this plan, else a new run."""
        plain = json.loads(json.dumps(plan))
        runs = self.runs()
        if runs and runs[-1].seconds is None and runs[-1].plan == plain:
            return runs[-1]
        today = datetime.date.today().isoformat()
        self._append({"plan": plain, "date": today})
        return Run(plan=plain, date=today)

    def add(self, run: Run, trial: str, point: str, figures: Figures) -> None:
        """Write the figures of one point in one trial; values alone if the plan names them."""
        names = run.plan.get("figures")
        stored = dict(figures) if names is None else [figures[name] for name in names if figures]
        self._write(run, {"trial": trial, "point": point, "figures": stored})

    def leave_out(self, run: Run, trial: str, why: str) -> None:
        """Write that a trial counts for no point, and why."""
        self._write(run, {"trial": trial, "left_out": why})

    def end(self, run: Run, seconds: float, notes: list[str]) -> None:
        """Write that a run has ended."""
        self._write(run, {"seconds": seconds, "notes": notes})

    def _write(self, run: Run, record: Mapping[str, Any]) -> None:
        self._append(record)
        _take(run, record)

    def _append(self, record: Mapping[str, Any]) -> None:
        append_line(self.path, json.dumps(record, sort_keys=True, allow_nan=False), durable=True)


def _take(run: Run, record: Mapping[str, Any]) -> None:
    if "figures" in record:
        figures = record["figures"]
        if isinstance(figures, list):
            figures = dict(zip(run.plan["figures"], figures, strict=bool(figures)))
        run.trials.setdefault(record["trial"], {})[record["point"]] = figures
    elif "left_out" in record:
        run.left_out[record["trial"]] = record["left_out"]
    else:
        run.seconds = record["seconds"]
        run.notes = record["notes"]
