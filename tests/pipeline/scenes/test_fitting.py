"""The draw among rows that are looked at in parts is the draw among all of them in memory."""

from collections.abc import Sequence

import numpy as np
import pytest

from pipeline.scenes import fitting
from pipeline.scenes.fitting import FitTable, drawn_rows
from storage.errors import Rejected


def _slow_twin(
    rng: np.random.Generator, least: Sequence[int], camps: Sequence[str], count: int, total: int
) -> list[int] | None:
    """Look at every row for each object, and at every row after each of them."""
    allowed, left, drawn = set(range(len(least))), total, list[int]()
    for following in range(count - 1, -1, -1):
        fitting_rows = []
        for row in sorted(allowed):
            beside = [
                least[other]
                for other in allowed
                if not camps[row] or camps[other] in ("", camps[row])
            ]
            if least[row] + following * min(beside) <= left:
                fitting_rows.append(row)
        if not fitting_rows:
            return None
        row = fitting_rows[int(rng.integers(len(fitting_rows)))]
        drawn.append(row)
        left -= least[row]
        if camps[row]:
            allowed = {other for other in allowed if camps[other] in ("", camps[row])}
    return drawn


def test_parts_change_no_draw(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fitting, "_PART", 7)
    rejected = several = 0
    for trial in range(300):
        rng = np.random.default_rng(trial)
        num_rows, count = int(rng.integers(1, 40)), int(rng.integers(1, 5))
        least = rng.integers(1, 100, num_rows).tolist()
        camps = rng.choice(["", "", "a", "b"], num_rows).tolist()
        total = int(rng.integers(1, 300))
        expected = _slow_twin(np.random.default_rng(trial), least, camps, count, total)
        table = FitTable.of(least, camps)
        try:
            assert drawn_rows(np.random.default_rng(trial), table, count, total) == expected
        except Rejected:
            assert expected is None
        rejected += expected is None
        several += bool(expected) and max(expected or [0]) >= 7
    assert 15 < rejected < 150
    assert several > 75


def test_no_row_is_looked_at_where_all_fit() -> None:
    """Of a million objects, two are read for each that is drawn."""

    class Counting:
        def __init__(self, values: Sequence[int]) -> None:
            self.values, self.read = np.array(values), 0

        def __len__(self) -> int:
            return len(self.values)

        def __getitem__(self, rows: slice) -> np.ndarray:
            found = self.values[rows]
            self.read += len(found)
            return found

    least, camp = Counting(range(1, 1001)), Counting([0] * 1000)
    table = FitTable(least, camp, [""], FitTable.of(range(1, 1001)).sizes)
    drawn_rows(np.random.default_rng(0), table, 3, 3000)
    assert (least.read, camp.read) == (3, 3)
    drawn_rows(np.random.default_rng(0), table, 3, 2000)
    assert least.read > 1000
