"""What a file of `bench card` says, as rows for people; the file may be anybody's.

Only numbers and plain words of it are shown, since the table becomes a part of a page.
"""

import math
import re
import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

_PLAIN = re.compile(r"[^\w .,()+:-]")
MOST_ROWS, MOST_CHARACTERS = 100, 60
NONE = "n/a"

RUN_NAMES = ("run", "scenes a pass", "ms a step", "not compiled", "at least", "H100 by count, ms",
             "TFLOP/s", "views/s", "GiB", "kernels", "the same by count",
             "dearest parts")  # fmt: skip
"""Headings of `run_rows`. `at least` is what the products alone take at the measured peak; `by
count` is what `trilight bench roofline` predicts of a compiled step on an H100."""


def facts(record: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield name and value of what was measured beside the runs."""
    card, machine = _map(record, "card"), _map(record, "machine")
    memory = _number(card.get("memory_gib"), 3)
    yield "card", f"{words(card.get('name'))}, {memory} GiB" if "memory_gib" in card else "none"
    driver = words(_map(card, "nvidia_smi").get("driver_version"))
    yield (
        "software",
        (
            f"driver {driver}, CUDA {words(card.get('cuda'))}, torch {words(card.get('torch'))}, "
            f"Trilight {words(machine.get('revision'))}"
        ),
    )
    yield "processor", f"{words(machine.get('processor'))}, {_number(machine.get('cores'))} cores"
    yield "products, TFLOP/s", _by_name(record, "products", 1e-12)
    yield "copies, GB/s", _by_name(record, "copies", 1e-9)
    for row in _list(record, "pictures"):
        place = f"{words(row.get('network'))} {words(row.get('precision'))}"
        yield (
            place,
            (
                f"{_number(row.get('db'), 3)} dB to its stored twin, "
                f"{_number(row.get('view_s'), 2, 1e3)} ms a view"
            ),
        )
    rendering = _map(record, "rendering")
    yield (
        "rendering",
        (
            f"{_number(rendering.get('views_an_hour'))} views an hour, "
            f"{_number(rendering.get('view_core_s'), 3)} core-seconds a view"
        ),
    )
    read = [
        f"{_number(row.get('samples_per_s'))} with {_number(row.get('threads'))} threads"
        for row in _list(record, "reading")
    ]
    yield "samples a second", "; ".join(read) or _failed(record.get("reading"))


def run_rows(record: Mapping[str, Any]) -> Iterator[list[str]]:
    """Yield the cells of each run, under RUN_NAMES."""
    for row in _list(record, "runs"):
        name = words(row.get("run"))
        if "failed" in row:
            yield [name, _failed(row), *[""] * (len(RUN_NAMES) - 2)]
            continue
        scenes, asked = _number(row.get("scenes")), _number(row.get("asked_scenes"))
        profile = _map(row, "profile")
        yield [
            name,
            scenes if scenes == asked else f"{scenes} of {asked}: memory",
            _median(row),
            _median(_map(row, "not_compiled")),
            _number(row.get("least_ms")),
            _number(_map(row, "h100").get("ms")),
            _number(row.get("teraflop_per_s"), 3),
            _number(row.get("views_per_s"), 3),
            _number(row.get("peak_gib"), 3),
            _number(profile.get("kernels")),
            _number(_map(row, "h100").get("kernels")),
            _dearest(_map(profile, "by_part_ms")),
        ]


def _median(row: Mapping[str, Any]) -> str:
    steps = [value for value in row.get("step_ms") or () if isinstance(value, int | float)]
    return _number(statistics.median(steps)) if steps else NONE


def _dearest(parts: Mapping[str, Any]) -> str:
    known = {name: value for name, value in parts.items() if isinstance(value, int | float)}
    total, order = sum(known.values()), sorted(known, key=lambda name: -known[name])
    return ", ".join(f"{words(name)} {known[name] / total:.0%}" for name in order[:2] if total > 0)


def markdown_of(records: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield a table of the runs on all cards as lines of Markdown, in the order given."""
    yield f"| card | {' | '.join(RUN_NAMES)} | measured |"
    yield f"|{'---|' * (len(RUN_NAMES) + 2)}"
    for record in records:
        card, date = words(_map(record, "card").get("name")), words(record.get("date"))
        for cells in run_rows(record):
            yield f"| {card} | {' | '.join(cells)} | {date} |"


def words(value: Any) -> str:
    """Return a word or a number of a record as plain text of bounded length."""
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        return NONE
    return _PLAIN.sub(" ", str(value))[:MOST_CHARACTERS].strip() or NONE


def _failed(value: Any) -> str:
    why = value.get("failed") if isinstance(value, Mapping) else None
    return f"not measured: {words(why)}"


def _number(value: Any, digits: int = 4, times: float = 1.0) -> str:
    """Return a number with some digits; others' nonsense is not one."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return NONE
    if isinstance(value, int) and times == 1.0:
        return str(value)[:MOST_CHARACTERS]
    shown = f"{value * times:.{digits}g}"
    return f"{float(shown):.0f}" if "e+" in shown else shown


def _by_name(record: Mapping[str, Any], name: str, times: float) -> str:
    rates = _map(record, name)
    if "failed" in rates:
        return _failed(rates)
    return ", ".join(f"{words(key)} {_number(value, 3, times)}" for key, value in rates.items())


def _map(record: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    value = record.get(name)
    return value if isinstance(value, Mapping) else {}


def _list(record: Mapping[str, Any], name: str) -> list[Mapping[str, Any]]:
    value = record.get(name)
    rows = value if isinstance(value, list) else []
    return [row for row in rows[:MOST_ROWS] if isinstance(row, Mapping)]
