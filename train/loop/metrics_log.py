"""metrics.jsonl: one JSON object per line, cut back to the checkpoint when a run resumes."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from storage.atomic import write_atomically, write_error


class MetricsLog:
    """Appends rows, each with the step after which it was taken."""

    def __init__(self, path: Path, *, first_step: int) -> None:
        """Keep the rows up to `first_step`: later ones will be written again.

        A line that a kill cut short is dropped with them, since it is the last.
        """
        self.path = path
        kept = [row for row in read_rows(path) if row["step"] <= first_step]
        write_atomically(path, "".join(_line(row) for row in kept).encode())

    def append(self, row: Mapping[str, Any]) -> None:
        """Write one row at once, so that it can be followed while the run goes on."""
        try:
            with self.path.open("a") as stream:
                stream.write(_line(row))
        except OSError as error:
            raise write_error(self.path, error) from error


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the whole rows of a log; a missing file has none."""
    if not path.exists():
        return []
    whole_lines = path.read_text().split("\n")[:-1]
    return [json.loads(line) for line in whole_lines]


def _line(row: Mapping[str, Any]) -> str:
    return json.dumps(row, sort_keys=True) + "\n"
