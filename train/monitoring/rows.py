"""Reader of metrics.jsonl, and writer of notes.jsonl: one JSON object per line."""

import json
import time
from pathlib import Path
from typing import Any

from storage.atomic import append_line
from storage.errors import TrilightError
from storage.records.safe_read import read_plain
from storage.typed_json import read_json_lines

LAYER_COLUMNS = ("grad_norm", "weight_norm", "update_ratio")
"""Values of a layer in a row: norm of its gradient before clipping, norm of its weights, and norm
of the update divided by that of the weights."""


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a log, each with its `step`; a missing file has none.

    Raises:
        TrilightError: a line before the last is invalid; the last may be incomplete after a kill.
    """
    if not path.exists():
        return []
    rows = read_json_lines(read_plain(path), dict[str, Any], str(path), torn_end=True)
    for number, row in enumerate(rows, start=1):
        if not isinstance(row.get("step"), int):
            raise TrilightError(f"{path}:{number}: step is {row.get('step')!r}; expected a number.")
    return rows


def add_note(path: Path, step: int, text: str) -> None:
    """Append a sentence without its full stop.

    Args:
        step: number of steps that were done by then.

    Raises:
        TrilightError: the folder is full or cannot be written.
    """
    line = json.dumps({"step": step, "at_unix_s": round(time.time()), "text": text})
    append_line(path, line)
