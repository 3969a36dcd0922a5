"""Store of a leaderboard's scores in rows.jsonl, so that no view is evaluated twice.

The first line of the file names the dataset; each other one is a `Row`.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from storage.atomic import append_line
from storage.errors import TrilightError
from storage.records.safe_read import read_plain
from storage.typed_json import read_json_lines
from train.evaluation.timing import Price

UNKNOWN_MACHINE = "a machine that is not named"
"""Machine of old rows, which do not name theirs."""


class RowKey(NamedTuple):
    """Key of a row."""

    width: int
    """Width of the picture in pixels."""
    scene: str
    """Key of the scene's sample in the dataset."""
    view: int
    """Row of the camera in the scene."""
    name: str
    """Name of the method, as in the table."""
    digest: str
    """SHA-256 of everything that decides the picture and its evaluation."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """Scores and times of one picture."""

    scores: Mapping[str, float | None]
    """Value by metric; None is n/a."""
    first_s: float | None = None
    """CPU seconds of the scene's first view, loading included; None if it is not timed."""
    further_s: float | None = None
    """CPU seconds of a further view; None if it is not timed."""
    machine: str | None = None
    """Processor of the times; None without times."""
    facts: Mapping[str, Any] | None = None
    """Facts of the scene, in rows of the targets' noise only."""


class Rows:
    """Rows in rows.jsonl of a folder."""

    def __init__(self, path: Path, set_digest: str) -> None:
        """Read the file if it exists, else begin it.

        Raises:
            TrilightError: the file holds rows of another dataset, or no rows.
        """
        self.path = path
        self._rows: dict[RowKey, Row] = {}
        self._prices: dict[tuple[RowKey, str], Price] = {}
        data = read_plain(path) if path.is_file() else b""
        try:
            records = read_json_lines(data, dict[str, Any], str(path), torn_end=True)
            if not records:
                self._append({"set": set_digest})
                return
            stored_digest = str(records[0]["set"])
            for record in records[1:]:
                key = RowKey(*(record.pop(name) for name in RowKey._fields))
                self._keep(key, Row(**record))
        except (ValueError, KeyError, TypeError) as error:
            raise TrilightError(
                f"{path}: not the rows of a leaderboard ({error}). Choose another --out, or delete "
                "the file."
            ) from error
        if stored_digest != set_digest:
            raise TrilightError(
                f"{path}: its rows are of the set {stored_digest[:12]}, and this set is "
                f"{set_digest[:12]}; expected the same set. Choose another --out."
            )

    def get(self, key: RowKey) -> Row | None:
        """Return the row of a key, or None."""
        return self._rows.get(key)

    def price(self, key: RowKey, machine: str) -> Price | None:
        """Return the CPU seconds of first and further view on a machine, or None."""
        return self._prices.get((key, machine))

    def machines(self) -> set[str]:
        """Return the names of all machines with times."""
        return {machine for _, machine in self._prices}

    def add(self, key: RowKey, row: Row) -> None:
        """Append a row to the file; of two rows with one key the later one counts."""
        plain = {name: value for name, value in asdict(row).items() if value is not None}
        self._append({**key._asdict(), **plain})
        self._keep(key, row)

    def _keep(self, key: RowKey, row: Row) -> None:
        self._rows[key] = row
        if row.first_s is not None and row.further_s is not None:
            price = Price(first_s=row.first_s, further_s=row.further_s)
            self._prices[key, row.machine or UNKNOWN_MACHINE] = price

    def _append(self, record: Mapping[str, Any]) -> None:
        append_line(self.path, json.dumps(record, sort_keys=True, allow_nan=False), durable=True)
