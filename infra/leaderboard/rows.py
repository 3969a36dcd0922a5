"""rows.jsonl: who scored what on which view, one JSON line each, so that nothing is judged twice.

A line is known by width, scene, view, name of the contestant, and the digest of all that decides
the picture and how it is judged. The first line says of which set the others are.
"""

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from storage.atomic import write_error
from storage.errors import TrilightError
from storage.records.safe_read import read_plain

UNKNOWN_MACHINE = "a machine that is not named"
"""Of rows that were written before they named it."""

Scores = Mapping[str, float | None]
"""Value by metric; None is n/a."""


@dataclass(frozen=True, kw_only=True)
class RowKey:
    """What a row is known by."""

    width: int
    """Pixels across the picture."""
    scene: str
    """Key of the sample."""
    view: int
    """Which of its cameras."""
    name: str
    """Who made the picture."""
    digest: str
    """Of all that decides it, and of how it is judged."""


@dataclass(frozen=True, kw_only=True)
class BoardRow:
    """One picture's scores."""

    scores: Scores
    first_s: float | None = None
    """Core-seconds of the scene's first view, its loading included; None where it is not timed."""
    further_s: float | None = None
    """And of a further view."""
    machine: str | None = None
    """What these were measured on, as infra.processor.processor calls it."""
    facts: Mapping[str, Any] | None = None
    """What is known of the scene, beside the scores of the reference's own noise."""


class BoardRows:
    """The rows of a folder."""

    def __init__(self, path: Path, set_digest: str) -> None:
        """Read what is there.

        Raises:
            TrilightError: the rows are of another set, or are no rows.
        """
        self.path = path
        self._rows: dict[RowKey, BoardRow] = {}
        self._priced: dict[tuple[RowKey, str], BoardRow] = {}
        lines = self._whole_lines()
        if not lines:
            self._append({"set": set_digest})
            return
        try:
            stored_digest = str(json.loads(lines[0])["set"])
            for line in lines[1:]:
                self._keep(*_row(json.loads(line)))
        except (ValueError, KeyError, TypeError) as error:
            raise TrilightError(
                f"{path}: not the rows of a leaderboard ({error}). Choose another --out, or delete "
                "the file."
            ) from error
        if stored_digest != set_digest:
            raise TrilightError(
                f"{path}: its rows are of the set {stored_digest[:12]}, and SOURCE is "
                f"{set_digest[:12]}; expected the same set. Choose another --out."
            )

    def get(self, key: RowKey) -> BoardRow | None:
        """Return the row of a key, if it is there."""
        return self._rows.get(key)

    def price(self, key: RowKey, machine: str) -> tuple[float, float] | None:
        """Return the core-seconds of first and further view on a machine; None where they lack."""
        row = self._priced.get((key, machine))
        if row is None or row.first_s is None or row.further_s is None:
            return None
        return row.first_s, row.further_s

    def machines(self) -> set[str]:
        """Return the names of all machines that something was timed on."""
        return {machine for _, machine in self._priced}

    def add(self, key: RowKey, row: BoardRow) -> None:
        """Write a row at once; of two with one key the later one counts."""
        plain = {name: value for name, value in asdict(row).items() if value is not None}
        self._append({**asdict(key), **plain})
        self._keep(key, row)

    def _keep(self, key: RowKey, row: BoardRow) -> None:
        self._rows[key] = row
        if row.first_s is not None:
            self._priced[key, row.machine or UNKNOWN_MACHINE] = row

    def _whole_lines(self) -> list[bytes]:
        """Return the lines, and cut off one that was being written when a run was killed."""
        data = read_plain(self.path) if self.path.is_file() else b""
        end = data.rfind(b"\n") + 1
        if end < len(data):
            os.truncate(self.path, end)
        return data[:end].splitlines()

    def _append(self, record: Mapping[str, Any]) -> None:
        line = json.dumps(record, sort_keys=True, allow_nan=False).encode() + b"\n"
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("ab") as stream:
                stream.write(line)
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            raise write_error(self.path, error) from error


def _row(record: dict[str, Any]) -> tuple[RowKey, BoardRow]:
    names = RowKey.__dataclass_fields__
    key = RowKey(**{name: record.pop(name) for name in names})
    return key, BoardRow(**record)
