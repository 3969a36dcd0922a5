"""Costs of a machine are shipped ones times what its probes take; threads share what they can."""

import numpy as np
import pytest

from infra.rendering.machine_costs import PROBED_PX, Timed, costs_of
from infra.rendering.way_table import shipped_table
from tests.for_each import case

CORES = 8


def timed_as_shipped(slower: float, serial: float) -> Timed:
    """Return what probes take where everything is slower, and a share of it stays serial."""
    table = shipped_table()
    then = {(row.part, row.width): row.serial_s + row.parallel_s for row in table.probe.rows}
    parts = {row.part for row in table.probe.rows}
    return {
        (px, threads): {
            part: slower * then[part, px] * (serial + (1 - serial) / threads) for part in parts
        }
        for px in PROBED_PX
        for threads in (1, CORES)
    }


def test_every_part_is_as_much_slower_and_as_serial() -> None:
    for slower, serial in [(1.0, 0.0), (2.5, 0.25), (0.1, 1.0)]:
        with case(slower):
            table = shipped_table()
            found = costs_of(table, timed_as_shipped(slower, serial), CORES, "here")
            assert found.machine == "here"
            for now, then in zip(found.rows, table.costs.rows, strict=True):
                core_s = then.serial_s + then.parallel_s
                assert (now.part, now.width) == (then.part, then.width)
                # the table keeps four figures
                assert now.serial_s == pytest.approx(slower * serial * core_s, rel=1e-3, abs=1e-9)
                assert now.parallel_s == pytest.approx(
                    slower * (1 - serial) * core_s, rel=1e-3, abs=1e-9
                )


def test_what_threads_seem_to_slow_down_is_serial() -> None:
    """Beside other work all threads may take longer than one; nothing becomes negative."""
    timed = timed_as_shipped(1.0, 0.0)
    timed |= {(px, CORES): {p: 3 * s for p, s in timed[px, 1].items()} for px in PROBED_PX}
    for row in costs_of(shipped_table(), timed, CORES, "here").rows:
        assert row.parallel_s == 0 and row.serial_s > 0


def test_one_core_is_measured_once() -> None:
    timed: Timed = {(px, 1): each for (px, threads), each in timed_as_shipped(2.0, 0.0).items()
             if threads == 1}  # fmt: skip
    for row in costs_of(shipped_table(), timed, 1, "here").rows:
        assert row.serial_s == 0 and row.parallel_s > 0


def test_between_the_probed_widths_machines_differ_by_what_lies_between() -> None:
    table = shipped_table()
    timed = timed_as_shipped(1.0, 0.0)
    low, high = PROBED_PX
    timed |= {(high, n): {p: 3 * s for p, s in timed[high, n].items()} for n in (1, CORES)}
    then = {(row.part, row.width): row.serial_s + row.parallel_s for row in table.costs.rows}
    for row in costs_of(table, timed, CORES, "here").rows:
        slower = float(np.interp(np.log2(row.width), np.log2((low, high)), (1.0, 3.0)))
        assert row.parallel_s == pytest.approx(slower * then[row.part, row.width], rel=1e-3)


def test_a_part_that_was_not_timed_costs_what_is_shipped() -> None:
    timed: Timed = {
        key: {part: s for part, s in each.items() if not part.startswith("network")}
        for key, each in timed_as_shipped(2.0, 0.0).items()
    }
    shipped = {(row.part, row.width): row for row in shipped_table().costs.rows}
    for row in costs_of(shipped_table(), timed, CORES, "here").rows:
        if row.part.startswith("network"):
            assert row == shipped[row.part, row.width]
