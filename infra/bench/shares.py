"""One experiment in shares: measured by several calls, on several machines, and put together again.

For experiments that take days. A share is every N-th turn or, where points stand alone, every N-th
row, a point in a turn; it has a file of its own beside the results, so that no two calls write into
one, and goes on where it stopped. A call without a share takes all over that lie there, and
measures the rest.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from infra.bench.experiment import Figures
from infra.bench.machine import named
from infra.bench.store import Run, Store
from storage.errors import TrilightError

_KEPT = ("versions", "revision")
"""Of a machine: what figures of other machines must agree with; errors do not depend on the rest,
and core-seconds are what the note of a share says of its machine."""


@dataclass(frozen=True, kw_only=True)
class Share:
    """Some of the rows of an experiment."""

    number: int
    """Which share, from 1."""
    of: int
    """How many there are."""

    def path(self, results: Path) -> Path:
        """Return the file of the share, beside the results."""
        return results.with_name(f"{results.stem}.share-{self.number}-of-{self.of}.jsonl")

    def holds(self, row: int) -> bool:
        """Return whether a row belongs to it, counted from 0 over all turns."""
        return row % self.of == self.number - 1


def share_of(text: str) -> Share:
    """Return the share that a person typed, such as 3/40.

    Raises:
        TrilightError: it is none.
    """
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        raise TrilightError(
            f"share {text!r}: expected K/N, the K-th of N shares, from 1/N to N/N; such as 3/40."
        )
    return Share(number=int(found[1]), of=int(found[2]))


def rows_of(
    turns: Sequence[str], points: Sequence[str], share: Share, *, apart: bool
) -> dict[str, list[str]]:
    """Return the points of a share by turn; its neighbours are in other shares.

    Args:
        turns: all.
        points: of each turn.
        share: whose.
        apart: whether the points of a turn may be measured apart from each other; else a share
            holds whole turns.
    """
    if not apart:
        held = {turn: share.holds(index) for index, turn in enumerate(turns)}
        return {turn: list(points) if mine else [] for turn, mine in held.items()}
    rows = [(turn, point) for turn in turns for point in points]
    found: dict[str, list[str]] = {turn: [] for turn in turns}
    for index, (turn, point) in enumerate(rows):
        if share.holds(index):
            found[turn].append(point)
    return found


def shared_rows(results: Path, plan: Mapping[str, Any]) -> Iterator[tuple[str, str, Figures, str]]:
    """Yield what the shares beside some results have measured: turn, point, figures, machine.

    Only of runs whose plan is this one, but for the machine's hardware.
    """
    for path in sorted(results.parent.glob(f"{results.stem}.share-*-of-*.jsonl")):
        for run in Store(path).runs():
            if _comparable(run.plan) == _comparable(plan):
                yield from _rows(run)


def _rows(run: Run) -> Iterator[tuple[str, str, Figures, str]]:
    for turn, points in run.turns.items():
        for point, figures in points.items():
            yield turn, point, figures, named(run.plan["machine"])


def _comparable(plan: Mapping[str, Any]) -> dict[str, Any]:
    plain: dict[str, Any] = json.loads(json.dumps(plan))
    machine = plain.get("machine", {})
    return {**plain, "machine": {name: machine.get(name) for name in _KEPT}}
