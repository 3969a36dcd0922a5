"""Progress of a training run, from its folder and without torch."""

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from storage.errors import TrilightError
from storage.records.safe_read import read_plain
from storage.typed_json import read_json
from train.folder import RunFolder, read_rows

FIGURES = {
    "training_loss": ("loss",),
    "validation_log_l1": ("validation", "log_l1"),
    "validation_psnr_log_db_median": ("validation", "psnr_log_db_median"),
    "views_per_s": ("views_per_s",),
}
"""Keys in a row of metrics.jsonl of each figure whose last value is reported."""


def is_run(root: Path) -> bool:
    """Return whether a folder is that of a training run."""
    folder = RunFolder(root)
    return folder.settings.is_file() and folder.metrics.is_file()


def tensorboard_command(root: Path) -> str:
    """Return the command that shows curves and pictures of a run."""
    return shlex.join(["tensorboard", "--logdir", str(root)])


def run_facts(root: Path) -> dict[str, Any]:
    """Return the progress of a run as JSON values, without figures that are not known yet.

    Raises:
        TrilightError: the folder holds no run, or a file is damaged.
    """
    if not is_run(root):
        raise TrilightError(f"{root}: no run here; expected a folder that `trilight train` wrote.")
    folder = RunFolder(root)
    try:
        place = str(folder.settings)
        settings = read_json(read_plain(folder.settings), dict[str, Any], place)["settings"]
        rows = read_rows(folder.metrics)
        step = max((row["step"] for row in rows), default=0)
        planned = settings["num_steps"]
        facts = {
            "run": settings.get("run"),
            "steps": step,
            "steps_planned": planned,
            "finished": folder.summary.exists() and step >= planned,
            "spikes": sum("spike" in row for row in rows),
        }
        latest = {name: _latest(rows, names) for name, names in FIGURES.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise TrilightError(
            f"{root}: settings.json or metrics.jsonl of the run is not readable ({error}). Restore "
            "it from a copy."
        ) from error
    return facts | {name: value for name, value in latest.items() if value is not None}


def _latest(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> float | None:
    """Return the last finite number of a figure."""
    for row in reversed(rows):
        value: Any = row
        for name in names:
            value = value.get(name) if isinstance(value, Mapping) else None
        if isinstance(value, int | float) and math.isfinite(value):
            return value
    return None
