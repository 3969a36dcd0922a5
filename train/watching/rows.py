"""Reads metrics.jsonl: one JSON object a line."""

import json
from pathlib import Path
from typing import Any

LAYER_COLUMNS = ("grad_norm", "weight_norm", "update_ratio")
"""What a row tells of a layer: length of its gradient before clipping, length of its weights, and
how far the update moved them as a share of that length."""


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the whole rows of a log; a missing file has none."""
    if not path.exists():
        return []
    whole_lines = path.read_text().split("\n")[:-1]
    return [json.loads(line) for line in whole_lines]
