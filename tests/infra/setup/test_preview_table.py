"""The shipped table is made of kept rows: medians of the scenes that every width was judged on."""

import json
from pathlib import Path

import pytest

from infra.bench.experiments.previews import (
    NETWORK,
    PROBES,
    WIDTHS,
    ladder,
    part_name,
    preview_name,
    timed_names,
)
from infra.bench.run import RESULTS
from infra.bench.store import Store
from infra.rendering.way_table import SHIPPED
from infra.setup.preview_table import made_from
from storage.errors import TrilightError
from storage.settings.described import settings_record

TURNS = ["held-out 0", *PROBES]


def write_results(folder: Path) -> None:
    """Write parts of three scenes, and errors of the three, but at one width of two alone."""
    parts = Store(folder / "preview-parts.jsonl")
    names = [part_name(name, px) for px in WIDTHS for name in timed_names()]
    machine = {"processor": "some processor"}
    run = parts.begin({"points": names, "turns": TURNS, "machine": machine})
    for at, turn in enumerate(TURNS):
        for name in names:
            parts.add(run, turn, name, {"core_s": float([1, 2, 6][at])})
    parts.end(run, 1.0, [])
    for px in WIDTHS:
        turns = TURNS[:2] if px == 512 else TURNS
        store = Store(folder / f"previews-{px}-quick.jsonl")
        points = [NETWORK, *(preview_name(*one) for one in ladder(px))]
        run = store.begin({"points": points, "turns": TURNS})
        for at, turn in enumerate(turns):
            for row, point in enumerate(points):
                store.add(run, turn, point, {"db": 20.0 + row + 10 * at})


def test_rows_become_medians_of_common_scenes(tmp_path: Path) -> None:
    write_results(tmp_path)
    table = made_from(tmp_path)
    assert table.scenes == 2
    assert table.costs.machine == "some processor, one thread"
    first = table.errors[0]
    assert (first.rung, first.median_db, first.least_db) == ("network", 25.0, 20.0)
    assert len(table.errors) == sum(1 + len(ladder(px)) for px in WIDTHS)
    for row, probe in zip(table.costs.rows, table.probe.rows, strict=True):
        assert (row.part, row.width) == (probe.part, probe.width)
        assert row.serial_s + row.parallel_s == 2.0
        assert probe.serial_s + probe.parallel_s == 4.0
        assert (row.parallel_s == 0) == (row.part == "scene")


def test_without_results_it_says_what_to_run(tmp_path: Path) -> None:
    with pytest.raises(TrilightError, match="run: trilight bench previews"):
        made_from(tmp_path)


def test_what_is_shipped_is_of_the_kept_rows() -> None:
    assert json.loads(SHIPPED.read_bytes()) == json.loads(
        json.dumps(settings_record(made_from(RESULTS)))
    )
