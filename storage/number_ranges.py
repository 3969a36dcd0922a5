"""Numbers of tasks or shards as schedulers write them: 0-3,7."""

import itertools
import re
from collections.abc import Iterable

MOST_NUMBERS = 100_000
"""That ranges in a text may name: one that names more would fill the memory."""

_RANGES = re.compile(r"\d{1,9}(-\d{1,9})?(,\d{1,9}(-\d{1,9})?)*", re.ASCII)


def number_ranges(numbers: Iterable[int]) -> str:
    """Return numbers as schedulers write them, such as 0-3,7; an empty text for none."""
    pairs = enumerate(sorted(set(numbers)))
    runs = (
        [number for _, number in run]
        for _, run in itertools.groupby(pairs, key=lambda pair: pair[1] - pair[0])
    )
    return ",".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs)


def numbers_of(ranges: str) -> list[int]:
    """Return the numbers that `number_ranges` wrote; none of another text, or of too many."""
    if not _RANGES.fullmatch(ranges):
        return []
    runs = [
        range(int(first), int(last or first) + 1)
        for first, _, last in (run.partition("-") for run in ranges.split(","))
    ]
    total = sum(map(len, runs))
    return list(itertools.chain.from_iterable(runs)) if total <= MOST_NUMBERS else []
