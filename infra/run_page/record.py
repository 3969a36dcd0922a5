"""What the folder of a run tells, read without torch."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from storage.errors import TrilightError
from train.folder import RunFolder
from train.watching.notes import read_notes
from train.watching.rows import read_rows

Row = Mapping[str, Any]

FIGURES = {
    "training_loss": ("loss",),
    "validation_log_l1": ("validation", "log_l1"),
    "validation_psnr_log_db_median": ("validation", "psnr_log_db_median"),
    "views_per_s": ("views_per_s",),
}
"""What is told first, and where it stands in the log."""


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """A run so far."""

    folder: RunFolder
    """Where it is."""
    begun: Row
    """settings.json: settings, digest of the data, versions, processes."""
    rows: Sequence[Row]
    """metrics.jsonl."""
    notes: Sequence[Row]
    """notes.jsonl."""
    summary: Row | None
    """summary.json of a finished run, else None."""

    @property
    def settings(self) -> Row:
        """The settings of the run."""
        found: Row = self.begun["settings"]
        return found

    @property
    def last_step(self) -> int:
        """Steps that the log reaches."""
        return max((row["step"] for row in self.rows), default=0)

    def points(self, *names: str) -> list[tuple[int, float]]:
        """Return step and value of a figure, such as `validation`, `log_l1`, where it is there."""
        return self.points_of(lambda row: _inner(row, names))

    def points_of(self, value: Callable[[Row], Any]) -> list[tuple[int, float]]:
        """Return step and what a function makes of each row, where that is a finite number."""
        found = [(row["step"], value(row)) for row in self.rows]
        return [
            (step, number)
            for step, number in found
            if isinstance(number, int | float) and math.isfinite(number)
        ]

    def layers(self, column: int) -> dict[str, list[tuple[int, float]]]:
        """Return step and figure of each layer; `column` is one of watching.rows.LAYER_COLUMNS."""
        found: dict[str, list[tuple[int, float]]] = {}
        for row in self.rows:
            for name, figures in row.get("layers", {}).items():
                if figures[column] is not None:
                    found.setdefault(name, []).append((row["step"], figures[column]))
        return found

    @property
    def finished(self) -> bool:
        """Whether it came to its end."""
        return self.summary is not None and self.last_step >= self.settings["num_steps"]

    @property
    def spikes(self) -> list[Row]:
        """Rows of spikes, oldest first."""
        return [row for row in self.rows if "spike" in row]


def read_record(root: Path) -> RunRecord:
    """Read the folder of a run.

    Raises:
        TrilightError: it holds no run, or a file that is damaged.
    """
    folder = RunFolder(root)
    if not is_run(root):
        raise TrilightError(f"{root}: no run here; expected a folder that `trilight train` wrote.")
    try:
        summary = json.loads(folder.summary.read_text()) if folder.summary.exists() else None
        record = RunRecord(
            folder=folder,
            begun=json.loads(folder.settings.read_text()),
            rows=read_rows(folder.metrics),
            notes=read_notes(folder.notes),
            summary=summary,
        )
        _ = record.settings["num_steps"], record.last_step
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise unreadable(root, error) from error
    return record


def unreadable(root: Path, error: Exception) -> TrilightError:
    """Return the user's view of a damaged file of a run."""
    return TrilightError(
        f"{root}: settings.json, summary.json, metrics.jsonl or notes.jsonl of the run is not "
        f"readable ({error}). Restore it from a copy."
    )


def facts_of(record: RunRecord) -> dict[str, Any]:
    """Return how far a run is, as JSON values; what is not known yet is left out."""
    found: dict[str, Any] = {
        "run": record.settings.get("run"),
        "steps": record.last_step,
        "steps_planned": record.settings["num_steps"],
        "finished": record.finished,
        "spikes": len(record.spikes),
    }
    for name, names in FIGURES.items():
        if points := record.points(*names):
            found[name] = points[-1][1]
    return found


def is_run(root: Path) -> bool:
    """Return whether a folder is one that a training wrote."""
    folder = RunFolder(root)
    return folder.settings.is_file() and folder.metrics.is_file()


def _inner(row: Any, names: Sequence[str]) -> Any:
    for name in names:
        row = row.get(name) if isinstance(row, Mapping) else None
    return row
