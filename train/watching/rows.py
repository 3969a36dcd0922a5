"""Reads metrics.jsonl: one JSON object a line."""

from pathlib import Path
from typing import Any

from storage.errors import TrilightError
from storage.records.safe_read import read_plain
from storage.typed_json import read_json_lines

LAYER_COLUMNS = ("grad_norm", "weight_norm", "update_ratio")
"""What a row tells of a layer: length of its gradient before clipping, length of its weights, and
how far the update moved them as a share of that length."""


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a log, each with its `step`; a missing file has none.

    Raises:
        TrilightError: a line before the last is no such row; of the last, a kill may have cut it.
    """
    if not path.exists():
        return []
    rows = read_json_lines(read_plain(path), dict[str, Any], str(path), torn_end=True)
    for number, row in enumerate(rows, start=1):
        if not isinstance(row.get("step"), int):
            raise TrilightError(f"{path}:{number}: step is {row.get('step')!r}; expected a number.")
    return rows
