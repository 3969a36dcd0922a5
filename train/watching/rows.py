"""Reads metrics.jsonl: one JSON object a line."""

import json
from pathlib import Path
from typing import Any

from storage.records.safe_read import read_plain

LAYER_COLUMNS = ("grad_norm", "weight_norm", "update_ratio")
"""What a row tells of a layer: length of its gradient before clipping, length of its weights, and
how far the update moved them as a share of that length."""


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the whole rows of a log; a missing file has none."""
    if not path.exists():
        return []
    whole_lines = read_plain(path).decode().split("\n")[:-1]
    return [json.loads(line) for line in whole_lines]
